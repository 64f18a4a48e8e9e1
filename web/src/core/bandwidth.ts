/** Measures the bandwidth of the link. */

import type { Clock } from "./download";

const SAMPLE = 100; // ms of downloading per sample
const MEMORY = 2000; // ms: time constant of the bandwidth average
const QUICK = 200; // ms, for samples above the average: a link seems slow while little is requested

/** Bandwidth over all downloads, bytes per second, measured while there are any. */
export class Bandwidth {
  rate = Number.NaN;
  private bytes = 0;
  private busy = 0; // ms in this sample
  private since = Number.NaN;

  constructor(private readonly clock: Clock) {}

  /** To be called when the first download starts, and when the last one has ended. */
  running(any: boolean): void {
    this.count(0);
    this.since = any ? this.clock.now() : Number.NaN;
  }

  count(bytes: number): void {
    const now = this.clock.now();
    if (!Number.isNaN(this.since)) {
      this.busy += now - this.since;
      this.since = now;
    }
    this.bytes += bytes;
    if (this.busy < SAMPLE) return;
    const rate = (1000 * this.bytes) / this.busy;
    const old = Number.isNaN(this.rate) ? 0 : Math.exp(-this.busy / (rate > this.rate ? QUICK : MEMORY));
    this.rate = old ? old * this.rate + (1 - old) * rate : rate;
    this.bytes = 0;
    this.busy = 0;
  }
}
