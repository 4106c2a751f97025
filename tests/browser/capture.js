// Captures a video, a canvas, and a camera as a stream and as a track.

import * as lib from "/test-page/client/index.js";

const camera = await navigator.mediaDevices.getUserMedia({ video: true });
export const video = document.createElement("video");
Object.assign(video, { muted: true, srcObject: camera });
await video.play();

const canvas = new OffscreenCanvas(320, 180);
setInterval(() => canvas.getContext("2d").drawImage(video, 0, 0, canvas.width, canvas.height), 20);

const sources = { video, canvas, stream: camera, track: camera.getVideoTracks()[0] };

const sleep = (seconds) => new Promise((resolve) => setTimeout(resolve, 1000 * seconds));

/** Captures a source until `count` answers have come. Returns them, and how many frames came after the stop. */
export async function capture(name, count, options) {
  const stream = new lib.LaneClient(location.origin).stream();
  const errors = [];
  stream.on("error", (error) => errors.push(error.message));
  const capturing = lib.captureFrames(sources[name], stream, options);
  const answers = [];
  for await (const { width, height, timestamp, lanes } of stream) {
    answers.push({ width, height, timestamp, lanes: lanes.length });
    if (answers.length === count) {
      break;
    }
  }
  capturing.stop();
  await sleep(0.1);
  const last = stream.lastSeq;
  await sleep(0.2);
  const more = stream.lastSeq - last;
  return { answers, errors, more, summary: await stream.end() };
}
