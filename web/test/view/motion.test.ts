import { expect, test } from "vitest";
import { between, dolly, look, orbit, type Rig, rigAt, walk } from "../../src/view/motion";

const rig: Rig = { position: [0, 1.6, 4], yaw: 0, pitch: 0, roll: 0, reach: 4 };

function close(found: readonly number[], wanted: readonly number[]): void {
  expect(found).toHaveLength(wanted.length);
  for (const [i, value] of wanted.entries()) expect(found[i]).toBeCloseTo(value, 6);
}

test("orbiting keeps what is looked at", () => {
  close(orbit(rig, Math.PI / 2, 0).position, [4, 1.6, 0]);
  close(orbit(rig, 0, -Math.PI / 6).position, [0, 1.6 + 2, 4 * Math.cos(Math.PI / 6)]);
});

test("walking stays on the level, whatever the pitch", () => {
  const up = look(rig, Math.PI / 2, 1);
  close(walk(up, 0, 0, 2).position, [-2, 1.6, 4]);
  close(walk(up, 1, 0.5, 0).position, [0, 2.1, 3]);
});

test("nobody looks further than straight up, and the first turn levels the camera", () => {
  expect(look(rig, 0, 9).pitch).toBeLessThan(Math.PI / 2);
  expect(Math.abs(look({ ...rig, roll: 0.3 }, 0.3, 0).roll)).toBe(0);
});

test("coming closer never passes what is looked at", () => {
  let near = rig;
  for (let i = 0; i < 100; i += 1) near = dolly(near, 0.8);
  expect(near.position[2]).toBeGreaterThan(0);
  close(dolly(rig, 0.5).position, [0, 1.6, 2]);
});

test("a journey begins and ends where it should and turns the short way", () => {
  const to = rigAt([1, 2, 3], [0, Math.sin(0.2), 0, Math.cos(0.2)], 2);
  close(between(rig, to, 0).position, rig.position);
  close(between(rig, to, 1).position, to.position);
  expect(between(rig, to, 1).yaw).toBeCloseTo(0.4, 6);
  expect(between({ ...rig, yaw: 3.1 }, { ...rig, yaw: -3.1 }, 0.5).yaw).not.toBeCloseTo(0, 1);
});
