import type { LaneStream } from "./stream.js";

export type FrameSource = HTMLVideoElement | MediaStream | MediaStreamTrack | HTMLCanvasElement | OffscreenCanvas;

export interface CaptureOptions {
  /** Frames are scaled down to this width in pixels; the results are in pixels of the smaller image. */
  maxWidth?: number;
  /** The quality of the JPEGs, from 0 to 1. */
  quality?: number;
  /** The most frames per second. */
  fps?: number;
}

export interface Capture {
  stop(): void;
}

/**
 * Sends the frames of a video element, a camera or a canvas to a stream in mode `latest`, until `stop` is called or the
 * stream has ended. A frame for which the stream has no time is skipped and not encoded. A video that is paused or has
 * no picture yet sends nothing.
 */
export function captureFrames(source: FrameSource, stream: LaneStream, options: CaptureOptions = {}): Capture {
  const { maxWidth = 1280, quality = 0.8, fps = 30 } = options;
  const picture = pictureOf(source);
  const canvas = newCanvas();
  const context = canvas.getContext("2d", { alpha: false }) as CanvasRenderingContext2D | null;
  let encoding = false;
  let stopped = false;
  let lastAt = -Infinity;

  async function sendFrame(): Promise<void> {
    const [width, height] = picture.size();
    const now = performance.now();
    // A timer of a display with 60 Hz never meets a period exactly.
    const early = now - lastAt < 1000 / fps - 4;
    if (encoding || early || width === 0 || context === null || !stream.wantsFrame) {
      return;
    }
    encoding = true;
    lastAt = now;
    try {
      const scale = Math.min(1, maxWidth / width);
      canvas.width = Math.round(scale * width);
      canvas.height = Math.round(scale * height);
      context.drawImage(picture.image, 0, 0, canvas.width, canvas.height);
      const image = await toJpeg(canvas, quality);
      if (!stopped) {
        void stream.send(image, { timestamp: now / 1000 });
      }
    } catch (error) {
      // For example a video of another origin, whose pixels a page may not read.
      stop();
      throw error;
    } finally {
      encoding = false;
    }
  }

  function stop(): void {
    stopped = true;
    stopTimer();
    stopListening();
    picture.release();
  }

  const stopTimer = onEachFrame(picture.image, fps, () => void sendFrame());
  const stopListening = stream.on("state", ({ state }) => {
    if (state === "ended" || state === "failed") {
      stop();
    }
  });
  if (stream.state === "ended" || stream.state === "failed") {
    stop();
  }
  return { stop };
}

interface Picture {
  readonly image: HTMLVideoElement | HTMLCanvasElement | OffscreenCanvas;
  /** Returns the width and the height; 0 if there is no new picture. */
  size(): [number, number];
  release(): void;
}

function pictureOf(source: FrameSource): Picture {
  if (isVideo(source)) {
    const size = (): [number, number] =>
      source.paused || source.readyState < source.HAVE_CURRENT_DATA ? [0, 0] : [source.videoWidth, source.videoHeight];
    return { image: source, size, release: () => {} };
  }
  if (!("getTracks" in source) && !("applyConstraints" in source)) {
    return { image: source, size: () => [source.width, source.height], release: () => {} };
  }
  const video = document.createElement("video");
  video.muted = video.playsInline = true;
  video.srcObject = "getTracks" in source ? source : new MediaStream([source]);
  void video.play().catch(() => {});
  return { ...pictureOf(video), release: () => (video.srcObject = null) };
}

/** Calls `callback` for each new frame of a video where the browser offers that, and `fps` times per second otherwise. */
function onEachFrame(image: Picture["image"], fps: number, callback: () => void): () => void {
  if (!isVideo(image) || !("requestVideoFrameCallback" in image)) {
    const timer = setInterval(callback, 1000 / fps);
    return () => clearInterval(timer);
  }
  let handle = 0;
  const next = (): void => {
    callback();
    handle = image.requestVideoFrameCallback(next);
  };
  handle = image.requestVideoFrameCallback(next);
  return () => image.cancelVideoFrameCallback(handle);
}

function isVideo(source: FrameSource): source is HTMLVideoElement {
  return "videoWidth" in source;
}

function newCanvas(): HTMLCanvasElement | OffscreenCanvas {
  return typeof OffscreenCanvas === "undefined" ? document.createElement("canvas") : new OffscreenCanvas(1, 1);
}

function toJpeg(canvas: HTMLCanvasElement | OffscreenCanvas, quality: number): Promise<Blob> {
  if ("convertToBlob" in canvas) {
    return canvas.convertToBlob({ type: "image/jpeg", quality });
  }
  return new Promise((resolve, reject) => {
    const done = (blob: Blob | null): void => (blob ? resolve(blob) : reject(new Error("the frame can't be encoded")));
    canvas.toBlob(done, "image/jpeg", quality);
  });
}
