/** The entropy coder of coded streams: docs/formats.md specifies it. */

const BITS = 14;
const TOTAL = 1 << BITS; // of the frequencies of a row
const LOWEST = 2 ** 23; // state
const COUNTED = 32; // what a symbol adds to its count
const MOST = 2 ** 16; // sum of counts beyond which they are halved
const PIECE = 6; // bits of a slot that the index of symbols leaves out

/** Counts of symbols by row, and the frequencies that follow from them. */
export class Table {
  readonly counts: Int32Array;
  readonly firsts: Uint16Array; // [rows, symbols + 1]
  readonly index: Uint8Array; // [rows, 256]: the symbol of every 64th slot
  readonly used: Uint8Array; // rows with symbols in this block

  constructor(
    readonly rows: number,
    readonly symbols: number,
    count: (symbol: number, row: number) => number,
  ) {
    this.counts = Int32Array.from({ length: rows * symbols }, (_, i) =>
      count(i % symbols, Math.floor(i / symbols)),
    );
    this.firsts = new Uint16Array(rows * (symbols + 1));
    this.index = new Uint8Array(rows << (BITS - PIECE));
    this.used = new Uint8Array(rows).fill(1);
    this.endBlock();
  }

  /** Renews the frequencies of the rows that were used. */
  endBlock(): void {
    for (let row = 0; row < this.rows; row++) {
      if (!this.used[row]) continue;
      this.used[row] = 0;
      this.renew(row, this.counts.subarray(row * this.symbols, (row + 1) * this.symbols));
    }
  }

  private renew(row: number, counts: Int32Array): void {
    let sum = 0;
    let possible = 0;
    let largest = 0;
    for (let s = 0; s < counts.length; s++) {
      sum += counts[s] as number;
      if (counts[s]) possible++;
    }
    while (sum > MOST) {
      sum = 0;
      for (let s = 0; s < counts.length; s++) sum += counts[s] = ((counts[s] as number) + 1) >> 1;
    }
    const start = row * (this.symbols + 1);
    let given = 0;
    for (let s = 0; s < counts.length; s++) {
      const count = counts[s] as number;
      const frequency = count ? Math.floor((count * (TOTAL - possible)) / sum) + 1 : 0;
      this.firsts[start + s + 1] = frequency; // for now
      given += frequency;
      if (count > (counts[largest] as number)) largest = s;
    }
    this.firsts[start + largest + 1] = (this.firsts[start + largest + 1] as number) + TOTAL - given;
    const index = this.index.subarray(row << (BITS - PIECE), (row + 1) << (BITS - PIECE));
    for (let s = 0, first = 0; s < counts.length; s++) {
      const end = first + (this.firsts[start + s + 1] as number);
      // the slots 64 i with first <= 64 i < end
      index.fill(s, (first + (1 << PIECE) - 1) >> PIECE, (end + (1 << PIECE) - 1) >> PIECE);
      this.firsts[start + s + 1] = first = end;
    }
  }
}

/** Reads one payload; throws where it is damaged. */
export class Reader {
  private state: number;
  private at = 4;

  constructor(private readonly bytes: Uint8Array) {
    this.state = bytes.length < 4 ? 0 : new DataView(bytes.buffer, bytes.byteOffset).getUint32(0);
    if (this.state < LOWEST || this.state >= LOWEST * 256) throw new Error("an impossible first state");
  }

  /** Symbols into `out`: all of the row `rows`, or each of its own. */
  symbols(table: Table, rows: number | Int32Array, out: Int32Array, count: number): void {
    const { bytes } = this;
    const { symbols, firsts, index, counts } = table;
    let { state, at } = this;
    for (let i = 0; i < count; i++) {
      const row = typeof rows === "number" ? rows : (rows[i] as number);
      const slot = state & (TOTAL - 1);
      let symbol = index[(row << (BITS - PIECE)) | (slot >> PIECE)] as number;
      let place = row * (symbols + 1) + symbol;
      for (; (firsts[place + 1] as number) <= slot; place++) symbol++;
      const first = firsts[place] as number;
      state = Math.imul((firsts[place + 1] as number) - first, state >> BITS) + slot - first;
      while (state < LOWEST) state = (state << 8) | (bytes[at++] as number);
      out[i] = symbol;
      counts[row * symbols + symbol] = (counts[row * symbols + symbol] as number) + COUNTED;
      table.used[row] = 1;
    }
    this.state = state;
    this.goOn(at);
  }

  /** Appends `widths` bits to each of `values`: 14 to all that have as many left, then the next. */
  bits(widths: Int32Array, values: Float64Array, count: number): void {
    const { bytes } = this;
    let { state, at } = this;
    for (let more = true; more; ) {
      more = false;
      for (let i = 0; i < count; i++) {
        const left = widths[i] as number;
        if (left <= 0) continue;
        const shift = left < BITS ? BITS - left : 0;
        const slot = state & (TOTAL - 1);
        values[i] = (values[i] as number) * (TOTAL >> shift) + (slot >> shift);
        state = ((state >> BITS) << shift) + (slot & ((1 << shift) - 1));
        while (state < LOWEST) state = (state << 8) | (bytes[at++] as number);
        widths[i] = left - BITS;
        more ||= left > BITS;
      }
    }
    this.state = state;
    this.goOn(at);
  }

  private goOn(at: number): void {
    if (at > this.bytes.length) throw new Error("coded values are cut off");
    this.at = at;
  }

  /** Throws unless the payload ends here, as the encoder began. */
  finish(): void {
    if (this.state !== LOWEST || this.at !== this.bytes.length) throw new Error("coded values are damaged");
  }
}
