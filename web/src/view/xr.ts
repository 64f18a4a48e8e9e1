import { Euler, Matrix4, type Quaternion, Vector3 } from "three";
import { dead } from "./controls";
import { type Governor, governor, next, XR_SPLATS } from "./governor";
import type { Stage } from "./stage";

export type XrMode = "immersive-vr" | "immersive-ar";
export type Turning = "snap" | "smooth";

const HEAD = 1.6; // metres: eyes above the floor
const WALK = 2; // metres per second
const SMOOTH = 1.8; // radians per second
const SNAP = Math.PI / 6;
const RATE = 72; // frames per second, if the session does not report it

/** The session modes that this browser supports, of VR and AR passthrough. */
export async function offered(): Promise<XrMode[]> {
  const modes: XrMode[] = ["immersive-vr", "immersive-ar"];
  const asked = modes.map((mode) => navigator.xr?.isSessionSupported(mode).catch(() => false) ?? false);
  const answers = await Promise.all(asked);
  return modes.filter((_, i) => answers[i]);
}

/** A headset: session, locomotion by the controllers, and a splat limit by its frame rate. */
export class Headset {
  turning: Turning = "snap";
  session: XRSession | null = null;
  governor: Governor = governor(XR_SPLATS, 0);
  #turned = false;
  readonly #room = new Matrix4(); // from the room to the world

  /** @param onCap - called with a new splat limit; null: the headset is off */
  constructor(
    readonly stage: Stage,
    readonly most: () => number,
    readonly onCap: (count: number | null) => void,
  ) {
    stage.renderer.xr.enabled = true;
    stage.renderer.xr.setReferenceSpaceType("local-floor");
  }

  /** Starts a session; must be called from a click. Rejects if the browser refuses. */
  async enter(mode: XrMode): Promise<void> {
    if (this.session || !navigator.xr) return;
    const { xr } = this.stage.renderer;
    const session = await navigator.xr.requestSession(mode, { optionalFeatures: ["local-floor", "layers"] });
    this.session = session;
    session.addEventListener("end", () => this.#ended());
    this.#stand();
    this.stage.renderer.setClearAlpha(mode === "immersive-ar" ? 0 : 1);
    this.stage.layer.spark.sortRadial = true; // stable while the head turns
    await xr.setSession(session);
    this.#place();
    this.governor = governor(this.most(), performance.now());
    this.onCap(this.governor.cap);
  }

  async leave(): Promise<void> {
    await this.session?.end();
  }

  /** To be called once per frame of the session; `seconds` since the previous one, `count` splats shown. */
  update(seconds: number, count: number): void {
    if (!this.session) return;
    this.#move(seconds);
    const wanted = 1000 / (this.session.frameRate || RATE);
    const most = Math.min(this.most(), XR_SPLATS);
    const after = next(this.governor, seconds * 1000, wanted, performance.now(), most, count);
    if (after.cap !== this.governor.cap) this.onCap(after.cap);
    this.governor = after;
  }

  /** Places the room with its floor below the camera, facing the camera's direction. */
  #stand(): void {
    const { camera } = this.stage;
    this.#room.makeRotationY(headingOf(camera.quaternion));
    this.#room.setPosition(camera.position.x, camera.position.y - HEAD, camera.position.z);
  }

  #place(): void {
    this.stage.setRoom(this.#room.clone().invert());
  }

  #ended(): void {
    const { renderer, layer, camera } = this.stage;
    this.session = null;
    camera.applyMatrix4(this.#room); // the page's camera takes over the head's pose
    this.stage.setRoom(new Matrix4());
    renderer.setClearAlpha(1);
    layer.spark.sortRadial = false;
    this.stage.project();
    this.onCap(null);
  }

  #move(seconds: number): void {
    let turn = 0;
    for (const source of this.session?.inputSources ?? []) {
      const axes = source.gamepad?.axes ?? [];
      const [x, y] = axes.length >= 4 ? [axes[2], axes[3]] : [axes[0], axes[1]];
      const stick = [dead(x ?? 0), dead(y ?? 0)] as const;
      if (source.handedness === "right") turn = stick[0];
      else this.#walk(stick[0] * WALK * seconds, stick[1] * WALK * seconds);
    }
    this.#turn(turn, seconds);
  }

  /** Moves horizontally along the head's direction. */
  #walk(right: number, back: number): void {
    if (!right && !back) return;
    const heading = headingOf(this.stage.camera.quaternion);
    const step = new Vector3(right, 0, back).applyAxisAngle(UP, heading);
    this.#room.multiply(new Matrix4().makeTranslation(step));
    this.#place();
  }

  #turn(stick: number, seconds: number): void {
    if (this.turning === "smooth") this.#rotate(-stick * SMOOTH * seconds);
    else if (Math.abs(stick) < 0.4) this.#turned = false;
    else if (!this.#turned) {
      this.#turned = true;
      this.#rotate(-Math.sign(stick) * SNAP);
    }
  }

  /** Rotates the room about the head, so that the user's position does not change. */
  #rotate(angle: number): void {
    if (!angle) return;
    const head = this.stage.camera.position;
    this.#room
      .multiply(new Matrix4().makeTranslation(head))
      .multiply(new Matrix4().makeRotationY(angle))
      .multiply(new Matrix4().makeTranslation(head.clone().negate()));
    this.#place();
  }
}

const UP = new Vector3(0, 1, 0);

const headingOf = (q: Quaternion): number => new Euler().setFromQuaternion(q, "YXZ").y;
