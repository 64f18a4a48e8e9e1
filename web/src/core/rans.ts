/** The entropy coder of coded streams: docs/formats.md specifies it. */

const BITS = 14;
const TOTAL = 1 << BITS; // of the frequencies of a row
const LOWEST = 2 ** 23; // state
const COUNTED = 128; // what a symbol adds to its count
const MOST = 2 ** 18; // sum of counts beyond which they are halved
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
    this.counts = new Int32Array(rows * symbols);
    for (let row = 0, i = 0; row < rows; row++) {
      for (let symbol = 0; symbol < symbols; symbol++) this.counts[i++] = count(symbol, row);
    }
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
      this.renew(row);
    }
  }

  private renew(row: number): void {
    const { symbols, counts, firsts, index } = this;
    const low = row * symbols;
    const high = low + symbols;
    let [sum, possible] = [0, 0];
    for (let i = low; i < high; i++) {
      const count = counts[i] as number;
      sum += count;
      if (count > 0) possible++;
    }
    while (sum > MOST) {
      sum = 0;
      for (let i = low; i < high; i++) {
        counts[i] = ((counts[i] as number) + 1) >> 1;
        sum += counts[i] as number;
      }
    }
    const share = Math.floor(((TOTAL - possible) * 2 ** 16) / sum);
    let [left, largest] = [TOTAL, low];
    for (let i = low; i < high; i++) {
      const count = counts[i] as number;
      if (count > 0) left -= (Math.imul(count, share) >> 16) + 1;
      if (count > (counts[largest] as number)) largest = i;
    }
    const end = (row + 1) << (BITS - PIECE);
    let next = row << (BITS - PIECE); // of the index
    for (let i = low, first = 0, at = low + row; i < high; i++, at++) {
      const count = counts[i] as number;
      if (count > 0) first += (Math.imul(count, share) >> 16) + 1;
      if (i === largest) first += left;
      firsts[at + 1] = first;
      const until = (end << PIECE) - TOTAL + first;
      for (; next << PIECE < until; next++) index[next] = i - low;
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

  /**
   * Symbols less `zero` into `out`: all of one row, or each of its own.
   * How many were the table's last symbol.
   */
  symbols(table: Table, rows: number | Int32Array, zero: number, out: Int32Array, count: number): number {
    return typeof rows === "number"
      ? this.ofRow(table, rows, zero, out, count)
      : this.ofRows(table, rows, zero, out, count);
  }

  private ofRow(table: Table, row: number, zero: number, out: Int32Array, count: number): number {
    const { bytes } = this;
    const { symbols, firsts, index, counts } = table;
    const [start, base, indices] = [row * (symbols + 1), row * symbols, row << (BITS - PIECE)];
    let { state, at } = this;
    let last = 0;
    for (let i = 0; i < count; i++) {
      const slot = state & (TOTAL - 1);
      let symbol = index[indices | (slot >> PIECE)] as number;
      let end = firsts[start + symbol + 1] as number;
      while (end <= slot) end = firsts[start + ++symbol + 1] as number;
      const first = firsts[start + symbol] as number;
      state = Math.imul(end - first, state >> BITS) + slot - first;
      while (state < LOWEST) state = (state << 8) | (bytes[at++] as number);
      out[i] = symbol - zero;
      if (symbol === symbols - 1) last++;
      counts[base + symbol] = (counts[base + symbol] as number) + COUNTED;
    }
    if (count) table.used[row] = 1;
    this.state = state;
    this.goOn(at);
    return last;
  }

  private ofRows(table: Table, rows: Int32Array, zero: number, out: Int32Array, count: number): number {
    const { bytes } = this;
    const { symbols, firsts, index, counts, used } = table;
    let { state, at } = this;
    let last = 0;
    for (let i = 0; i < count; i++) {
      const row = rows[i] as number;
      const slot = state & (TOTAL - 1);
      let symbol = index[(row << (BITS - PIECE)) | (slot >> PIECE)] as number;
      const start = row * (symbols + 1);
      let end = firsts[start + symbol + 1] as number;
      while (end <= slot) end = firsts[start + ++symbol + 1] as number;
      const first = firsts[start + symbol] as number;
      state = Math.imul(end - first, state >> BITS) + slot - first;
      while (state < LOWEST) state = (state << 8) | (bytes[at++] as number);
      out[i] = symbol - zero;
      if (symbol === symbols - 1) last++;
      const place = row * symbols + symbol;
      counts[place] = (counts[place] as number) + COUNTED;
      used[row] = 1;
    }
    this.state = state;
    this.goOn(at);
    return last;
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
