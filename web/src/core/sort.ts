/**
 * Writes the indices of splats from the farthest to the nearest, of equal ones the earlier first, and returns how
 * many there are. `keys` are the bits of depths as float32; infinite ones are left out. It must need nothing
 * around it: the build copies it into a worker (web/spark.ts).
 */
export function backToFront(count: number, keys: Uint32Array, ordering: Uint32Array): number {
  const infinite = 0x7f800000;
  const low = new Uint32Array(65536);
  const high = new Uint32Array(65536);
  let active = 0;
  for (let i = 0; i < count; i++) {
    const key = keys[i] as number;
    if (key >= infinite) continue;
    (low[~key & 65535] as number)++;
    (high[~key >>> 16] as number)++;
    active++;
  }
  for (const places of [low, high]) {
    let begin = 0;
    for (let i = 0; i < 65536; i++) {
      const n = places[i] as number;
      places[i] = begin;
      begin += n;
    }
  }
  const half = new Uint32Array(active);
  for (let i = 0; i < count; i++) {
    const key = keys[i] as number;
    if (key < infinite) half[(low[~key & 65535] as number)++] = i;
  }
  for (let i = 0; i < active; i++) {
    const at = half[i] as number;
    ordering[(high[~(keys[at] as number) >>> 16] as number)++] = at;
  }
  return active;
}
