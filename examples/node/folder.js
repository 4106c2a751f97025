// Sends the JPEGs of a folder and prints the lanes: node folder.js FOLDER [URL]. Needs Node 22 or later.

import { readdir, readFile } from "node:fs/promises";
import { join } from "node:path";
import { LaneClient } from "lanestream";

const [folder, url = "http://127.0.0.1:8000"] = process.argv.slice(2);
const names = (await readdir(folder)).filter((name) => /\.jpe?g$/i.test(name)).sort();
const stream = new LaneClient(url, { apiKey: process.env.LANESTREAM_API_KEY }).stream({ mode: "all" });
for (const [index, name] of names.entries()) {
  const { lanes, ego } = await stream.send(await readFile(join(folder, name)), { timestamp: index / 25 });
  console.log(name, lanes.map((lane) => `${lane.track_id} ${lane.kind} ${lane.state}`).join(", "), ego.offset);
}
console.log(await stream.end());
