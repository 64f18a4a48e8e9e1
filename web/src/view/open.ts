import { digestOfBrowser } from "../core/download";
import { Kept } from "../core/kept";
import { loadManifest } from "../core/manifest";
import { filesToDraw, type Streamer } from "../core/streamer";
import type { Options } from "../embed";
import type { Source } from "../inside";
import { Viewer } from "./viewer";

const KEEP_AFTER = 2000; // ms of rest

/**
 * A viewer on a new canvas that fills an element; `start` begins it. Rejects with a message for the user, and then
 * leaves the element as it was.
 *
 * @param keys - what hears the keys that move the camera (default: the canvas)
 */
export async function openViewer(
  element: HTMLElement,
  source: Source,
  options: Options,
  keys?: EventTarget,
): Promise<Viewer> {
  if (!document.createElement("canvas").getContext("webgl2")) {
    throw new Error("This browser has no WebGL 2; enable hardware acceleration or use another browser.");
  }
  const [manifest, kept] = await Promise.all([
    loadManifest(source.base, source.fetch),
    source.isInside ? null : Kept.open(source.base),
  ]);
  const known = await kept?.read(filesToDraw(manifest), digestOfBrowser);
  const canvas = document.createElement("canvas");
  canvas.tabIndex = 0;
  Object.assign(canvas.style, { display: "block", width: "100%", height: "100%", touchAction: "none" });
  element.append(canvas);
  try {
    const viewer = new Viewer(canvas, manifest, source, options, keys ?? canvas);
    if (known) viewer.streamer.know(known);
    if (kept) void keep(kept, viewer.streamer);
    return viewer;
  } catch (error) {
    canvas.remove();
    throw error;
  }
}

/** Keeps what a streamer downloads, soon after it has all that it wants. */
async function keep(kept: Kept, streamer: Streamer): Promise<void> {
  for (;;) {
    await new Promise<void>((resolve) => {
      const stop = streamer.onChange(() => {
        stop();
        resolve();
      });
    });
    await streamer.idle();
    await new Promise((resolve) => setTimeout(resolve, KEEP_AFTER));
    await kept.add(streamer.contents);
  }
}
