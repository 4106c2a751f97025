// What the types must allow and refuse. The compiler checks it; nothing runs it.

import { captureFrames, type Lane, LaneClient, LaneError, lanePoints, type StreamOptions } from "lanestream";

const client = new LaneClient(["http://a", "http://b"], { token: async () => "token", reconnectS: 0 });
const options: StreamOptions = { mode: "all", kinds: ["marking"], camera: { height: 1.4, field_of_view: 60 } };
const stream = client.stream(options);
const stop: () => void = stream.on("state", ({ state, resumed }) => state === "open" && resumed);
stream.on("error", (error: LaneError) => [error.code, error.hint, error.seq, error.httpStatus]);
stream.restart({ horizon: undefined });

export async function use(image: Uint8Array, video: HTMLVideoElement): Promise<[number, number][]> {
  const answer = await stream.send(image, { timestamp: 0.04, indicator: "left" });
  const lanes: Lane[] = answer?.lanes ?? (await client.detect(image, { kinds: ["road_edge"] })).lanes;
  for await (const { ego } of stream) {
    ego.offset?.toFixed();
  }
  captureFrames(video, stream, { fps: 10 }).stop();
  stop();
  return lanes.flatMap((lane) => lanePoints(lane));
}

// @ts-expect-error: there is no such event.
stream.on("lane", () => {});
// @ts-expect-error: a misspelled option.
client.stream({ mod: "all" });
// @ts-expect-error: a misspelled kind.
client.stream({ kinds: ["markings"] });
// @ts-expect-error: what an answer does not have.
void client.detect(new ArrayBuffer(0)).then((lanes) => lanes.lines);
