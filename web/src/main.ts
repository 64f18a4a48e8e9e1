import { inAdvance } from "./core/advance";
import type { Fetch } from "./core/download";
import { Kept } from "./core/kept";
import { bundleUrl, type Embed, linkTo, type Options, parseOptions } from "./embed";
import { bytesFrom, type Source, sourceInside } from "./inside";
import { formatName } from "./ui/format";
import { fail, hideNotice, messageOf } from "./ui/notice";
import { buildPage } from "./ui/page";
import { colorsOf } from "./view/colors";
import { openViewer } from "./view/open";
import { embed, type Viewer } from "./view/viewer";
import { readFrom } from "./view/wasm";

declare global {
  interface Window {
    /** The page's viewer. `ready` resolves when all else is there; it rejects with the message on the page. */
    sagesplat: { ready: Promise<void> } & Partial<Embed>;
  }
}

const ready = begin();
window.sagesplat = { ready };
ready.catch((error: unknown) => fail(messageOf(error)));

async function begin(): Promise<void> {
  await Promise.resolve(); // `window.sagesplat` exists before any error
  const options = parseOptions(location.search, location.hash);
  const app = document.getElementById("app");
  if (!app) throw new Error("This page is incomplete; copy the bundle again.");
  const inside = sourceInside(document);
  if (inside) {
    readFrom(() => bytesFrom(inside, "assets/spark.wasm"));
    await show(app, inside, options);
  } else await showOnline(app, options);
}

/**
 * Shows a bundle of a server. The pack that the page names is asked for together with the manifest, unless an
 * earlier visit kept levels.
 */
async function showOnline(app: HTMLElement, options: Options): Promise<void> {
  const base = bundleUrl(options.bundle, location.href);
  const online: Fetch = (url, init) => fetch(url, init);
  const named = options.bundle ? null : packNamed(document);
  if (!named || Kept.isKnown(base)) return show(app, { base, fetch: online }, options);
  const pack = inAdvance(online, new URL(named.uri, base).href, named.bytes);
  try {
    await show(app, { base, fetch: pack.fetch }, options);
  } finally {
    pack.cancel(); // an older page names an older pack; a broken bundle needs none
  }
}

async function show(app: HTMLElement, source: Source, options: Options): Promise<void> {
  const viewer = await openViewer(app, source, options, window);
  const { canvas } = viewer.stage;
  canvas.id = "view";
  app.removeAttribute("hidden");
  document.title = `${formatName(viewer.manifest.name)} · sagesplat`;
  hideNotice();
  if (options.ui) buildPage(app, viewer);
  window.sagesplat = Object.assign(window.sagesplat, embed(viewer));
  let here = location.href;
  viewer.onLost(
    () => {
      here = linkTo(location.href, viewer.pose(), viewer.settings);
      fail("The GPU context was lost, usually for lack of memory; reload the page with a smaller budget.");
    },
    () => location.replace(here), // Spark's textures do not come back
  );
  followTraining(viewer);
  viewer.start();
  removePosterWhenDrawn(viewer, canvas);
}

/** The pack that the page of a bundle names, and what every plan wants of it: asked for together with the manifest. */
function packNamed(page: ParentNode): { uri: string; bytes: number } | null {
  const content = page.querySelector<HTMLMetaElement>('meta[name="pack"]')?.content ?? "";
  const [, uri, bytes] = /^(\w[\w-]*\.pack) ([1-9]\d*)$/.exec(content) ?? [];
  return uri ? { uri, bytes: Number(bytes) } : null;
}

/** Removes the poster when the scene is drawn, or at the first input. */
function removePosterWhenDrawn(viewer: Viewer, canvas: HTMLCanvasElement): void {
  const poster = document.getElementById("poster");
  if (!poster) return;
  canvas.after(poster); // above the scene, below the panel
  if (poster instanceof HTMLImageElement)
    void meanOf(poster).then(
      (mean) => viewer.setMean(mean),
      () => {},
    );
  const down = () => {
    stop();
    poster.remove();
  };
  const stop = viewer.onSample(({ settled, drawn, state }) => {
    if (settled && drawn > 0 && state.status !== "loading") down();
  });
  for (const event of ["pointerdown", "wheel", "keydown"] as const) {
    canvas.addEventListener(event, down, { once: true });
  }
  if (viewer.photo >= 0) down(); // the poster shows another view
}

/** The mean colour of a picture, 0 to 255. */
async function meanOf(picture: HTMLImageElement): Promise<readonly number[]> {
  await picture.decode();
  const canvas = document.createElement("canvas");
  const context = canvas.getContext("2d");
  [canvas.width, canvas.height] = [16, 16];
  context?.drawImage(picture, 0, 0, 16, 16);
  const pixels = [...(context?.getImageData(0, 0, 16, 16).data ?? [])];
  return [0, 1, 2].map((i) => pixels.reduce((sum, value, k) => sum + (k % 4 === i ? value / 256 : 0), 0));
}

/** Reloads a live bundle when training is finished: it then has levels. */
function followTraining(viewer: Viewer): void {
  if (!viewer.manifest.live) return;
  viewer.streamer.onChange(() => {
    const { manifest } = viewer.streamer;
    viewer.stage.layer.setColors(colorsOf(manifest));
    if (!manifest.live) location.reload();
  });
}
