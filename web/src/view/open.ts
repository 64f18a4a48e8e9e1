import { loadManifest } from "../core/manifest";
import type { Options } from "../embed";
import type { Source } from "../inside";
import { Viewer } from "./viewer";

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
  const manifest = await loadManifest(source.base, source.fetch);
  const canvas = document.createElement("canvas");
  canvas.tabIndex = 0;
  Object.assign(canvas.style, { display: "block", width: "100%", height: "100%", touchAction: "none" });
  element.append(canvas);
  try {
    return new Viewer(canvas, manifest, source, options, keys ?? canvas);
  } catch (error) {
    canvas.remove();
    throw error;
  }
}
