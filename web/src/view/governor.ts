/** The splat limit of a headset: lowered when frames are late, raised slowly while they are on time. */
export interface Governor {
  readonly cap: number; // splats
  readonly late: number; // mean frame time, relative to the headset's
  readonly changed: number; // ms: time of the last change of `cap`
  readonly patience: number; // ms of timely frames before it is raised
}

export const XR_SPLATS = 500_000; // current headsets render these at 72 frames per second
const FEWEST = 20_000;
const LATE = 1.2; // relative to the headset's frame time
const ON_TIME = 1.08;
const SETTLE = 600; // ms that a lower count needs to take effect
const RAISE_WAIT = 4_000;

/** @param cap - initial limit, splats */
export function governor(cap: number, now: number): Governor {
  return { cap: Math.min(cap, XR_SPLATS), late: 1, changed: now, patience: RAISE_WAIT };
}

/**
 * The governor after one frame.
 * @param frame - ms since the previous frame
 * @param wanted - frame time of the headset, ms
 * @param most - the user's limit, splats
 * @param count - splats shown: a limit that is not reached is not raised
 */
export function next(
  g: Governor,
  frame: number,
  wanted: number,
  now: number,
  most: number,
  count: number,
): Governor {
  const late = g.late + (Math.min(frame / wanted, 10) - g.late) * 0.1;
  const quiet = now - g.changed;
  if (late > LATE && quiet > SETTLE && g.cap > FEWEST) {
    const cap = Math.max(FEWEST, Math.round(Math.min(g.cap, count) * 0.8));
    return { cap, late: 1, changed: now, patience: Math.min(g.patience * 2, 60_000) };
  }
  if (late < ON_TIME && quiet > g.patience && g.cap < most && count > g.cap * 0.7) {
    return { ...g, cap: Math.min(most, Math.round(g.cap * 1.1)), late, changed: now };
  }
  return { ...g, late };
}
