/** How many splats a headset takes: lowered when frames come late, raised slowly while they are on time. */
export interface Governor {
  readonly cap: number; // splats
  readonly late: number; // mean frame time over what the headset asks for
  readonly changed: number; // ms, when `cap` changed last
  readonly patience: number; // ms on time before it is raised again
}

export const XR_SPLATS = 500_000; // what headsets of today hold at 72 frames a second
const FEWEST = 20_000;
const LATE = 1.2; // times the headset's frame time
const ON_TIME = 1.08;
const SETTLE = 600; // ms that a lower count needs to take effect
const PATIENCE = 4_000;

/** @param cap - splats to begin with */
export function governor(cap: number, now: number): Governor {
  return { cap: Math.min(cap, XR_SPLATS), late: 1, changed: now, patience: PATIENCE };
}

/**
 * One frame later.
 * @param frame - ms since the frame before
 * @param wanted - ms that the headset asks for
 * @param most - splats that the user allows
 * @param count - splats that are shown: raising a limit that is not reached would mean nothing
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
