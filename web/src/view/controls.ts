import type { Bounds } from "./bounds";
import { between, dolly, look, orbit, pan, type Rig, walk } from "./motion";

export type Mode = "orbit" | "walk";

const SPEED = 1.4; // metres per second: walking speed
const FAST = 3.5; // factor with Shift
const TURN = 1.6; // radians per second, by keyboard and gamepad
const DRAG = 0.005; // radians per pixel
const STRIDE = 0.005; // metres per pixel that one of two fingers moves
const TRAVEL = 700; // ms from one photo to the next
const DEAD = 0.15; // dead zone of a gamepad's stick

/** Keys by `KeyboardEvent.code`: translation (right, up, forward) or rotation (yaw, pitch). */
const MOVE_KEYS: Readonly<Record<string, readonly [number, number, number]>> = {
  KeyW: [0, 0, 1],
  KeyS: [0, 0, -1],
  KeyA: [-1, 0, 0],
  KeyD: [1, 0, 0],
  KeyE: [0, 1, 0],
  KeyQ: [0, -1, 0],
};
const TURN_KEYS: Readonly<Record<string, readonly [number, number]>> = {
  ArrowLeft: [1, 0],
  ArrowRight: [-1, 0],
  ArrowUp: [0, 1],
  ArrowDown: [0, -1],
};

/** Whether an event goes to something that takes keys itself; a dialog that is closed does not. */
export const isTyping = ({ target }: Event): boolean =>
  target instanceof HTMLElement && target.closest("input, select, textarea, dialog[open]") !== null;

/** Orbit and walk by mouse, touch, keyboard and gamepad. */
export class Controls {
  mode: Mode = "orbit";
  readonly #keys = new Set<string>();
  readonly #pointers = new Map<number, { x: number; y: number; button: number }>();
  #travel: { from: Rig; to: Rig; start: number } | null = null;

  /**
   * @param onMove - called when the user or an animation moved the camera
   * @param bounds - where the user may go
   * @param keys - what hears the keys
   * @param signal - ends all of it
   */
  constructor(
    readonly canvas: HTMLElement,
    public rig: Rig,
    readonly onMove: (rig: Rig, byUser: boolean) => void,
    readonly bounds: Bounds,
    { keys, signal }: { readonly keys: EventTarget; readonly signal: AbortSignal },
  ) {
    canvas.addEventListener("pointerdown", (event) => this.#down(event), { signal });
    canvas.addEventListener("pointermove", (event) => this.#drag(event), { signal });
    for (const name of ["pointerup", "pointercancel", "lostpointercapture"] as const) {
      canvas.addEventListener(name, (event) => this.#pointers.delete(event.pointerId), { signal });
    }
    canvas.addEventListener("wheel", (event) => this.#wheel(event), { passive: false, signal });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault(), { signal });
    keys.addEventListener("keydown", (event) => this.#key(event as KeyboardEvent), { signal });
    window.addEventListener("keyup", (event) => this.#keys.delete(event.code), { signal });
    window.addEventListener("blur", () => this.#keys.clear(), { signal });
  }

  /** Moves the camera: immediately, or animated unless the user prefers reduced motion. */
  go(to: Rig, smooth: boolean): void {
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    if (smooth && !still) {
      this.#travel = { from: this.rig, to, start: performance.now() };
      return;
    }
    this.#travel = null;
    this.#set(to, false);
  }

  /** To be called once per frame; `seconds` since the previous one. */
  update(seconds: number): void {
    if (this.#travel) {
      const { from, to, start } = this.#travel;
      const t = Math.min(1, (performance.now() - start) / TRAVEL);
      if (t === 1) this.#travel = null;
      this.#set(t === 1 ? to : between(from, to, t), false);
    }
    this.#step(heldKeys(this.#keys), seconds);
    this.#step(heldPad(), seconds);
  }

  #step({ move, turn, fast }: Held, seconds: number): void {
    const pace = SPEED * (fast ? FAST : 1) * seconds;
    const [right, up, ahead] = move;
    if (right || up || ahead) this.#user(walk(this.rig, right * pace, up * pace, ahead * pace));
    const [yaw, pitch] = turn;
    if (yaw || pitch) this.#turn(yaw * TURN * seconds, pitch * TURN * seconds);
  }

  #turn(yaw: number, pitch: number): void {
    this.#user(this.mode === "orbit" ? orbit(this.rig, yaw, pitch) : look(this.rig, yaw, pitch));
  }

  #user(rig: Rig): void {
    this.#travel = null;
    this.#set(this.bounds.confine(this.rig, rig), true);
  }

  #set(rig: Rig, byUser: boolean): void {
    this.rig = rig;
    this.onMove(rig, byUser);
  }

  #down(event: PointerEvent): void {
    this.canvas.setPointerCapture(event.pointerId);
    this.#pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, button: event.button });
    if (document.activeElement instanceof HTMLElement) document.activeElement.blur();
    this.canvas.focus({ preventScroll: true });
  }

  #drag(event: PointerEvent): void {
    const last = this.#pointers.get(event.pointerId);
    if (!last) return;
    const [dx, dy] = [event.clientX - last.x, event.clientY - last.y];
    const other = [...this.#pointers].find(([id]) => id !== event.pointerId)?.[1];
    const before = other && Math.hypot(last.x - other.x, last.y - other.y);
    this.#pointers.set(event.pointerId, { ...last, x: event.clientX, y: event.clientY });
    if (other && before) {
      const after = Math.hypot(event.clientX - other.x, event.clientY - other.y);
      if (event.pointerType === "touch") this.#user(walk(this.rig, -dx * STRIDE, 0, dy * STRIDE));
      else this.#pan(dx / 2, dy / 2);
      this.#closer(before / Math.max(after, 1));
    } else if (last.button === 2 || last.button === 1 || event.shiftKey) this.#pan(dx, dy);
    else if (this.mode === "orbit") this.#turn(-dx * DRAG, -dy * DRAG);
    else this.#turn(dx * DRAG, dy * DRAG);
  }

  #pan(dx: number, dy: number): void {
    const metres = this.rig.reach / Math.max(this.canvas.clientHeight, 1);
    this.#user(pan(this.rig, -dx * metres, dy * metres));
  }

  #closer(factor: number): void {
    const { rig } = this;
    const most = this.bounds.step(rig);
    if (this.mode === "orbit") this.#user(dolly(rig, Math.max(factor, 1 - most / rig.reach)));
    else this.#user(walk(rig, 0, 0, Math.min(-Math.log(factor) * 3, most)));
  }

  #wheel(event: WheelEvent): void {
    event.preventDefault();
    const lines = event.deltaMode === WheelEvent.DOM_DELTA_PIXEL ? event.deltaY / 100 : event.deltaY / 3;
    this.#closer(1.12 ** Math.max(-4, Math.min(4, lines)));
  }

  #key(event: KeyboardEvent): void {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    if (isTyping(event) || !(event.code in MOVE_KEYS || event.code in TURN_KEYS)) return;
    event.preventDefault();
    this.#keys.add(event.code);
    if (event.shiftKey) this.#keys.add("ShiftLeft");
    else this.#keys.delete("ShiftLeft");
  }
}

interface Held {
  readonly move: readonly [number, number, number];
  readonly turn: readonly [number, number];
  readonly fast: boolean;
}

function heldKeys(keys: ReadonlySet<string>): Held {
  const move: [number, number, number] = [0, 0, 0];
  const turn: [number, number] = [0, 0];
  for (const key of keys) {
    MOVE_KEYS[key]?.forEach((value, i) => {
      move[i as 0 | 1 | 2] += value;
    });
    TURN_KEYS[key]?.forEach((value, i) => {
      turn[i as 0 | 1] += value;
    });
  }
  return { move, turn, fast: keys.has("ShiftLeft") };
}

/** The first gamepad with two sticks: left moves, right turns, the triggers go down and up. */
function heldPad(): Held {
  const pad = navigator.getGamepads?.().find((candidate) => candidate && candidate.axes.length >= 4);
  const axis = (i: number) => dead(pad?.axes[i] ?? 0);
  const button = (i: number) => pad?.buttons[i]?.value ?? 0;
  return {
    move: [axis(0), button(7) - button(6), -axis(1)],
    turn: [-axis(2), -axis(3)],
    fast: pad?.buttons[10]?.pressed ?? false,
  };
}

/** A stick's value with a dead zone around its centre. */
export function dead(value: number): number {
  return Math.abs(value) < DEAD ? 0 : (value - Math.sign(value) * DEAD) / (1 - DEAD);
}
