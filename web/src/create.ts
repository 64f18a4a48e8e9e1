/** What the npm package exports: a viewer in an element of any page. */

import type { Embed, Sample } from "./embed";
import type { Quality } from "./types";
import { openViewer } from "./view/open";
import { embed } from "./view/viewer";

export type { Camera, Label, LabelState, Level, Pose, Quality, Screens, Settings, State } from "./types";
export type { Embed, Sample };

/** What to show. */
export interface ViewerOptions {
  /** Folder of the bundle, relative to the page: "garden/". Another site has to allow it (CORS). */
  readonly bundle: string | URL;
  /** A photo to begin at, by name (default: the view that the bundle begins with). */
  readonly view?: string;
  /** What the target is of: "fidelity", SSIM against the full scene, or "ssim", against photos (default: the bundle's). */
  readonly quality?: Quality;
  /** Quality to keep, 0 to 1 (default: the bundle's). */
  readonly target?: number;
  /** Bytes to download at most, in MB; without a target the best quality within it is shown (default: no limit). */
  readonly budget?: number;
  /** Called when the browser takes the GPU away, usually for lack of memory. */
  readonly onLost?: () => void;
}

/**
 * Shows a bundle in an element of the page, which needs a size of its own. The scene streams in after the promise
 * has resolved. Keys move the camera while the canvas has the focus.
 *
 * Rejects with a message for the user where the bundle cannot be read or the browser cannot draw it.
 *
 * @example
 * const viewer = await createViewer(document.querySelector("#scene"), { bundle: "garden/" });
 * viewer.set({ target: 0.9 });
 */
export async function createViewer(element: HTMLElement, options: ViewerOptions): Promise<Embed> {
  const { bundle, view = null, quality = null, target = null, budget = null, onLost } = options;
  const base = new URL(bundle, document.baseURI);
  if (!base.pathname.endsWith("/")) base.pathname += "/";
  const source = { base, fetch: (url: string, init?: RequestInit) => fetch(url, init) };
  const shown = { view, pose: null, quality, target, budget, ui: false, bundle: "", edit: null };
  const viewer = await openViewer(element, source, shown);
  if (onLost) viewer.onLost(onLost);
  viewer.start();
  return embed(viewer);
}
