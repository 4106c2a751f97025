// Runs a scenario in Node: node run_scenario.js LIBRARY FRAMES NAME ARGUMENTS. Prints a line of JSON for each report and
// the result. Standard input ends when the test wants the scenario to stop.

import { readdirSync, readFileSync } from "node:fs";
import { join } from "node:path";
import * as scenarios from "./scenarios.js";

const [library, folder, name, args] = process.argv.slice(2);
const lib = await import(library);
const frames = readdirSync(folder)
  .sort()
  .map((file) => new Uint8Array(readFileSync(join(folder, file))));

let ended = false;
process.stdin.on("end", () => (ended = true)).resume();

const print = (value) => process.stdout.write(`${JSON.stringify(value)}\n`);
const report = (value) => print({ report: value });
const result = await scenarios[name]({ lib, frames, report, stopped: async () => ended, ...JSON.parse(args) });
print({ result });
process.stdin.destroy();
