import {
  Color,
  type Matrix4,
  PerspectiveCamera,
  SRGBColorSpace,
  Vector2,
  Vector3,
  WebGLRenderer,
} from "three";
import type { Ray } from "../core/pick";
import type { Camera, Manifest, Pose, Viewpoint } from "../types";
import { focalOf, lens, quat, rootMatrix, transformPose, vec3, viewpoint } from "./frame";
import { orientation, type Rig } from "./motion";
import { SparkLayer } from "./spark";

const FOV = 60; // degrees, of the window's shorter side, unless a photo's lens is set
const HIGHEST = 1.2; // tangent of half of a vertical field of view
const NEAR = 0.03; // metres
const LONGEST_HOLD = 600; // ms that a picture stays for want of the next one
const FAR = 1e5; // beyond the sky of a large scene: up to 100 scene extents away

/** The canvas: one camera and the adapted scene, beside the full scene while they are compared. */
export class Stage {
  readonly renderer: WebGLRenderer;
  readonly camera = new PerspectiveCamera(FOV, 1, NEAR, FAR);
  readonly layer: SparkLayer;
  readonly root: Matrix4; // from the bundle's frame to the camera's world
  full: SparkLayer | null = null;
  isSplit = false; // whether the full scene is shown; until it is ready the adapted one has the whole canvas
  split = 0.5; // share of the width that shows the full scene
  needsFrame = true;
  /** What is behind all that is drawn while something in sight is missing: the scene's mean colour. */
  mean: Color | null = null;
  isIncomplete = false;
  #photo: Camera | null = null;
  #fovY: number | null = null;
  readonly #background: Color; // that the scene was trained with
  #heldSince = Number.NaN; // ms

  /** Throws without WebGL 2. */
  constructor(
    readonly canvas: HTMLCanvasElement,
    readonly manifest: Manifest,
  ) {
    this.renderer = new WebGLRenderer({ canvas, antialias: false, powerPreference: "high-performance" });
    this.#background = background(manifest);
    this.root = rootMatrix(manifest.frame);
    this.layer = this.newLayer();
  }

  newLayer(onDirty: () => void = () => this.invalidate()): SparkLayer {
    return new SparkLayer(this.renderer, this.manifest, onDirty);
  }

  invalidate(): void {
    this.needsFrame = true;
  }

  /** Moves the world, since a headset's camera cannot be moved; `matrix` from the world to its room. */
  setRoom(matrix: Matrix4): void {
    this.root.multiplyMatrices(matrix, rootMatrix(this.manifest.frame));
    this.layer.place(this.root);
    this.invalidate();
  }

  /** Sets the camera's pose. A photo's lens is kept until `setLens` is called. */
  place(rig: Rig): void {
    this.camera.position.set(...rig.position);
    this.camera.quaternion.set(...orientation(rig));
    this.invalidate();
  }

  /** Sets the lens: a photo's, a vertical field of view in radians, or the default. */
  setLens(photo: Camera | null, fovY: number | null = null): void {
    this.#photo = photo;
    this.#fovY = fovY;
    this.project();
  }

  /** Fits the canvas to the window, unless the window has no area or a headset is on. */
  resize(width: number, height: number, ratio: number): void {
    if (width < 1 || height < 1 || this.renderer.xr.isPresenting) return;
    const before = this.renderer.getSize(new Vector2());
    if (before.x === width && before.y === height && this.renderer.getPixelRatio() === ratio) return;
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(width, height, false);
    this.project();
    this.draw(); // resizing clears the canvas
    this.invalidate(); // the plan for the new picture comes with the next frame
  }

  /** The camera's viewpoint in the bundle's frame. */
  pose(): Pose {
    const { position, quaternion, projectionMatrix } = this.camera; // in a headset, three keeps it at the head
    const fovY = 2 * Math.atan(1 / (projectionMatrix.elements[5] || 1));
    const pose = { position: vec3(position), quaternion: quat(quaternion), fovY };
    return transformPose(pose, this.root.clone().invert());
  }

  /** The ray through a point of the canvas (px from its corner), in the bundle's frame. */
  ray(x: number, y: number): Ray {
    const { camera, canvas } = this;
    camera.updateMatrixWorld();
    const inverse = this.root.clone().invert();
    const at = new Vector3((2 * x) / canvas.clientWidth - 1, 1 - (2 * y) / canvas.clientHeight, 0.5);
    const origin = camera.position.clone().applyMatrix4(inverse);
    const direction = at.unproject(camera).applyMatrix4(inverse).sub(origin).normalize();
    const forward = new Vector3(0, 0, -1).transformDirection(camera.matrixWorld).transformDirection(inverse);
    const pixels = this.renderer.getDrawingBufferSize(new Vector2()).y;
    const pixel = 2 / ((camera.projectionMatrix.elements[5] || 1) * Math.max(pixels, 1));
    return { origin: vec3(origin), direction: vec3(direction), forward: vec3(forward), pixel };
  }

  viewpoint(): Viewpoint {
    const { camera, root } = this;
    camera.updateMatrixWorld();
    return viewpoint(root, camera.matrixWorld, camera.projectionMatrix, this.#focal());
  }

  /** Focal length in pixels of what is drawn: of the canvas, in a headset of one eye's picture. */
  #focal(): number {
    const { xr } = this.renderer;
    const eye = xr.isPresenting ? xr.getCamera().cameras[0] : undefined; // none before the first frame
    if (eye) return focalOf(eye.projectionMatrix, eye.viewport.z, eye.viewport.w);
    const { x, y } = this.renderer.getDrawingBufferSize(new Vector2());
    return focalOf(this.camera.projectionMatrix, x, y);
  }

  /** Frees the GPU, also what the browser keeps for the canvas. */
  free(): void {
    this.renderer.setAnimationLoop(null);
    this.layer.free();
    this.renderer.dispose();
    this.renderer.forceContextLoss();
  }

  /** Draws a frame. After a jump the earlier one may stay until what has come into sight is sorted; says so. */
  draw(mayHold = false): boolean {
    this.needsFrame = false;
    const { renderer, camera } = this;
    renderer.setClearColor((this.isIncomplete && this.mean) || this.#background, 1);
    const view = this.viewpoint();
    for (const layer of [this.layer, this.full]) layer?.cull(view);
    if (this.#holds(view, mayHold && !renderer.xr.isPresenting)) return false;
    if (!this.full || !this.isSplit || renderer.xr.isPresenting) {
      renderer.render(this.layer.scene, camera);
      return true;
    }
    const size = renderer.getSize(new Vector2());
    const at = Math.round(size.x * this.split);
    renderer.setScissorTest(true);
    renderer.setScissor(0, 0, at, size.y);
    renderer.render(this.full.scene, camera);
    renderer.setScissor(at, 0, size.x - at, size.y);
    renderer.render(this.layer.scene, camera);
    renderer.setScissorTest(false);
    return true;
  }

  /** Whether the earlier frame stays, while the next one is sorted. */
  #holds(view: Viewpoint, may: boolean): boolean {
    const layers = [this.layer, this.isSplit ? this.full : null];
    const late = layers.filter((layer) => layer?.misses(view));
    if (!late.length) {
      this.#heldSince = Number.NaN;
      return false;
    }
    const now = performance.now();
    if (Number.isNaN(this.#heldSince)) this.#heldSince = now;
    if (!may || now - this.#heldSince > LONGEST_HOLD) return false;
    for (const layer of late) void layer?.spark.update({ scene: layer.scene, camera: this.camera });
    this.invalidate(); // Spark says once that it is dirty, until it draws
    return true;
  }

  /** Updates the projection after a change of size or lens, or a headset session. */
  project(): void {
    const { x, y } = this.renderer.getSize(new Vector2());
    const { camera } = this;
    camera.aspect = x / y;
    camera.fov = ((this.#fovY ?? this.#usual(camera.aspect)) * 180) / Math.PI;
    camera.updateProjectionMatrix();
    if (this.#photo) {
      const [left, right, top, bottom] = lens(this.#photo, x, y).map((edge) => edge * NEAR) as [
        number,
        number,
        number,
        number,
      ];
      camera.projectionMatrix.makePerspective(left, right, top, bottom, NEAR, FAR);
      camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
    }
    this.invalidate();
  }

  /** In a tall window no more is seen above and below than the photos saw: there is nothing beyond. */
  #usual(aspect: number): number {
    const half = Math.tan((FOV * Math.PI) / 360);
    const photos = this.manifest.cameras.map(({ fovY }) => Math.tan(fovY / 2));
    const most = photos.length ? Math.max(half, ...photos) : HIGHEST;
    return 2 * Math.atan(aspect < 1 ? Math.min(half / aspect, most, HIGHEST) : half);
  }
}

function background(manifest: Manifest): Color {
  return new Color().setRGB(...manifest.background, SRGBColorSpace);
}
