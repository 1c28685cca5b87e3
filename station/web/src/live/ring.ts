// The newest rows of numbers, in columns that grow as rows come: 500 cars must not reserve what one may need.

const FIRST_ROWS = 32;

/**
 * Rows of the last `keep_s` seconds by column 0, which ascends, and at most `most`. The rows are contiguous: when the
 * columns are full, the rows that are kept move to the front.
 */
export class Ring {
  private columns: Float64Array[];
  /** Grows with every insertion into the past. */
  inserted = 0;
  private size = FIRST_ROWS;
  private first = 0;
  private end = 0;

  constructor(
    width: number,
    private most: number,
    private keep_s: number,
  ) {
    this.columns = Array.from({ length: width }, () => new Float64Array(this.size));
  }

  get length(): number {
    return this.end - this.first;
  }

  get width(): number {
    return this.columns.length;
  }

  /** The oldest row's time; NaN without rows. */
  get start(): number {
    return this.length > 0 ? this.columns[0]![this.first]! : NaN;
  }

  /** Keep more or fewer rows from now on. */
  keep(keep_s: number, most: number): void {
    if (keep_s === this.keep_s && most === this.most) return;
    [this.keep_s, this.most] = [keep_s, most];
    this.drop();
    this.resize(Math.max(FIRST_ROWS, this.length * 2));
  }

  /** Add an empty column, and return its index. */
  widen(): number {
    this.columns.push(new Float64Array(this.size).fill(NaN));
    return this.columns.length - 1;
  }

  push(row: readonly number[]): void {
    if (this.end === this.size) {
      this.drop();
      // A quarter must become free, or moving rows would cost more than adding them.
      this.resize(this.length > this.size * 0.75 ? this.size * 2 : this.size);
    }
    for (let i = 0; i < this.columns.length; i += 1) this.columns[i]![this.end] = row[i] ?? NaN;
    this.end += 1;
    if (this.length > this.most) this.first += 1;
  }

  /** Add rows of the past, as columns by index with their times in column 0; rows of times that are known are left out. */
  insert(times: readonly number[], columns: ReadonlyMap<number, ArrayLike<number>>): void {
    const [mine, known] = [this.column(0).slice(), new Set(this.column(0))];
    const fresh = [...times.keys()].filter((row) => !known.has(times[row]!));
    if (fresh.length === 0) return;
    this.inserted += 1;
    const old = this.columns.map((column) => column.slice(this.first, this.end));
    const length = mine.length + fresh.length;
    this.size = length * 2;
    this.columns = old.map(() => new Float64Array(this.size).fill(NaN));
    let [a, b] = [0, 0];
    for (let to = 0; to < length; to += 1) {
      const own = b >= fresh.length || (a < mine.length && mine[a]! < times[fresh[b]!]!);
      for (const [i, column] of this.columns.entries()) {
        if (own) column[to] = old[i]![a]!;
        else column[to] = i === 0 ? times[fresh[b]!]! : (columns.get(i)?.[fresh[b]!] ?? NaN);
      }
      if (own) a += 1;
      else b += 1;
    }
    [this.first, this.end] = [Math.max(0, length - this.most), length];
  }

  /** The newest value of a column; NaN without one. */
  last(column: number): number {
    return this.length > 0 ? (this.columns[column]?.[this.end - 1] ?? NaN) : NaN;
  }

  /** A column from the row before `from` on, so that a line enters from the left. It is not a copy. */
  column(index: number, from = -Infinity): Float64Array {
    return this.columns[index]!.subarray(Math.max(this.first, this.search(from) - 1), this.end);
  }

  private drop(): void {
    this.first = Math.max(this.first, this.search(this.last(0) - this.keep_s) - 1, this.end - this.most);
  }

  private resize(size: number): void {
    this.columns = this.columns.map((old) => {
      const column = size === this.size ? old : new Float64Array(size).fill(NaN);
      column.set(old.subarray(this.first, this.end));
      return column;
    });
    this.size = size;
    [this.first, this.end] = [0, this.end - this.first];
  }

  /** The first row whose time, in column 0, is at least `from`. */
  private search(from: number): number {
    const times = this.columns[0]!;
    let [low, high] = [this.first, this.end];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (times[middle]! < from) low = middle + 1;
      else high = middle;
    }
    return low;
  }
}
