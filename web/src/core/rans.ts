/** The entropy coder of coded streams: docs/formats.md specifies it. */

const BITS = 14;
const TOTAL = 1 << BITS; // of the frequencies of a row
const LOWEST = 2 ** 23; // state
const COUNTED = 128; // what a symbol adds to its count
const RENEWED = 4; // of a row's counts, the part that has to be new before its frequencies are
const MOST = 2 ** 18; // sum of counts beyond which they are halved
const PIECE = 6; // bits of a slot that the index of symbols leaves out,
const FEW_PIECE = 8; // and those for
const FEW = 40; // symbols or fewer

const LISTS = ["counts", "slots", "index", "used", "sums", "possible", "lows", "highs"] as const;

/** Counts of symbols by row, and the frequencies that follow from them. */
export class Table {
  readonly counts: Int32Array;
  readonly slots: Int32Array; // [rows, symbols]: the first slot of a symbol, and its frequency << 14
  readonly index: Uint8Array; // [rows, 2^(14 - piece)]: the symbol of every 2^piece-th slot
  readonly piece: number;
  readonly used: Int32Array; // symbols of each row that were read since its frequencies were renewed
  readonly sums: Int32Array; // of the counts of a row then
  readonly possible: Int32Array; // symbols of a row that can occur,
  readonly lows: Int32Array; // the first of them,
  readonly highs: Int32Array; // and where they end, in `counts`

  /** @param count - of a symbol in a new table; null: `copy` fills it */
  constructor(
    readonly rows: number,
    readonly symbols: number,
    count: ((symbol: number, row: number) => number) | null,
  ) {
    const list = () => new Int32Array(rows);
    [this.used, this.sums, this.possible, this.lows, this.highs] = [list(), list(), list(), list(), list()];
    this.counts = new Int32Array(rows * symbols);
    this.slots = new Int32Array(rows * symbols);
    this.piece = symbols > FEW ? PIECE : FEW_PIECE;
    this.index = new Uint8Array(rows << (BITS - this.piece));
    for (let row = 0; count && row < rows; row++) {
      this.begin(row, count);
      this.renew(row);
    }
  }

  /** Another table that begins as this one is. */
  copy(): Table {
    const copy = new Table(this.rows, this.symbols, null);
    for (const name of LISTS) copy[name].set(this[name]);
    return copy;
  }

  private begin(row: number, count: (symbol: number, row: number) => number): void {
    const first = row * this.symbols;
    let [sum, possible, low, high] = [0, 0, -1, 0];
    for (let symbol = 0; symbol < this.symbols; symbol++) {
      const some = count(symbol, row);
      if (!some) continue;
      this.counts[first + symbol] = some;
      sum += some;
      possible += 1;
      if (low < 0) low = first + symbol;
      high = first + symbol + 1;
    }
    [this.sums[row], this.possible[row], this.lows[row], this.highs[row]] = [sum, possible, low, high];
  }

  /** Renews the frequencies of the rows that have enough of new symbols. */
  endBlock(): void {
    const { used, sums, rows } = this;
    for (let row = 0; row < rows; row++) {
      const more = used[row] as number;
      if (!more || RENEWED * COUNTED * more < (sums[row] as number)) continue;
      used[row] = 0;
      sums[row] = (sums[row] as number) + COUNTED * more;
      this.renew(row);
    }
  }

  private renew(row: number): void {
    const { symbols, counts, slots, index, piece } = this;
    const low = this.lows[row] as number;
    const high = this.highs[row] as number;
    while ((this.sums[row] as number) > MOST) this.halve(row, low, high);
    const share = Math.floor(
      ((TOTAL - (this.possible[row] as number)) * 2 ** 16) / (this.sums[row] as number),
    );
    let left = TOTAL;
    let largest = low;
    let most = 0;
    for (let i = low; i < high; i++) {
      const count = counts[i] as number;
      const frequency = count && (Math.imul(count, share) >> 16) + 1;
      slots[i] = frequency;
      left -= frequency;
      if (count > most) {
        most = count;
        largest = i;
      }
    }
    slots[largest] = (slots[largest] as number) + left;
    const base = row * symbols;
    const begin = row << (BITS - piece); // of the index
    const whole = (1 << piece) - 1;
    let next = begin;
    let first = 0;
    for (let i = low; i < high; i++) {
      const frequency = slots[i] as number;
      slots[i] = (first & (TOTAL - 1)) | (frequency << BITS);
      first += frequency;
      const end = begin + ((first + whole) >> piece);
      while (next < end) index[next++] = i - base;
    }
  }

  private halve(row: number, low: number, high: number): void {
    const { counts } = this;
    let sum = 0;
    for (let i = low; i < high; i++) {
      const half = ((counts[i] as number) + 1) >> 1;
      counts[i] = half;
      sum += half;
    }
    this.sums[row] = sum;
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

  /** Symbols of one row of a table, less `zero`, into `out`; how many were the table's last symbol. */
  ofRow(table: Table, row: number, zero: number, out: Int32Array, count: number): number {
    const { bytes } = this;
    const { symbols, slots, index, counts, piece } = table;
    const base = row * symbols;
    const indices = row << (BITS - piece);
    const final = base + symbols - 1;
    const origin = base + zero;
    let { state, at } = this;
    let escapes = 0;
    for (let i = 0; i < count; i++) {
      const slot = state & (TOTAL - 1);
      let place = base + (index[indices | (slot >> piece)] as number);
      let known = slots[place] as number;
      while (slot >= (known & (TOTAL - 1)) + (known >>> BITS)) known = slots[++place] as number;
      state = Math.imul(known >>> BITS, state >> BITS) + slot - (known & (TOTAL - 1));
      while (state < LOWEST) state = (state << 8) | (bytes[at++] as number);
      out[i] = place - origin;
      if (place === final) escapes++;
      counts[place] = (counts[place] as number) + COUNTED;
    }
    table.used[row] = (table.used[row] as number) + count;
    this.state = state;
    this.goOn(at);
    return escapes;
  }

  /** The same, each of its own row. */
  ofRows(table: Table, rows: Int32Array, zero: number, out: Int32Array, count: number): number {
    const { bytes } = this;
    const { symbols, slots, index, counts, used, piece } = table;
    let { state, at } = this;
    let escapes = 0;
    for (let i = 0; i < count; i++) {
      const row = rows[i] as number;
      const base = row * symbols;
      const slot = state & (TOTAL - 1);
      let place = base + (index[(row << (BITS - piece)) | (slot >> piece)] as number);
      let known = slots[place] as number;
      while (slot >= (known & (TOTAL - 1)) + (known >>> BITS)) known = slots[++place] as number;
      state = Math.imul(known >>> BITS, state >> BITS) + slot - (known & (TOTAL - 1));
      while (state < LOWEST) state = (state << 8) | (bytes[at++] as number);
      const symbol = place - base;
      out[i] = symbol - zero;
      if (symbol === symbols - 1) escapes++;
      counts[place] = (counts[place] as number) + COUNTED;
      used[row] = (used[row] as number) + 1;
    }
    this.state = state;
    this.goOn(at);
    return escapes;
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
