// Converts a JSON Schema on stdin to TypeScript on stdout.

import { text } from "node:stream/consumers";
import { compile } from "json-schema-to-typescript";

const options = {
  additionalProperties: false,
  bannerComment: "// The messages of the service, generated from their JSON Schemas by `make js-types`. Do not edit.",
  maxItems: 10,
  style: { printWidth: 120 },
};
process.stdout.write(await compile(JSON.parse(await text(process.stdin)), "Messages", options));
