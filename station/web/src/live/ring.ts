/**
 * The newest `capacity` rows of numbers, in columns of fixed length. Each column is twice as long as needed, so
 * that the rows are always contiguous: at the end, they move to the front.
 */
export class Ring {
  private readonly columns: Float64Array[];
  private first = 0;
  private end = 0;

  constructor(
    width: number,
    readonly capacity: number,
  ) {
    this.columns = Array.from({ length: width }, () => new Float64Array(2 * capacity));
  }

  get length(): number {
    return this.end - this.first;
  }

  get width(): number {
    return this.columns.length;
  }

  /** Add an empty column, and return its index. */
  widen(): number {
    this.columns.push(new Float64Array(2 * this.capacity).fill(NaN));
    return this.columns.length - 1;
  }

  push(row: readonly number[]): void {
    if (this.end === 2 * this.capacity) {
      for (const column of this.columns) column.copyWithin(0, this.first, this.end);
      this.end -= this.first;
      this.first = 0;
    }
    for (let i = 0; i < this.columns.length; i += 1) this.columns[i]![this.end] = row[i] ?? NaN;
    this.end += 1;
    if (this.length > this.capacity) this.first += 1;
  }

  /** The newest value of a column; NaN without one. */
  last(column: number): number {
    return this.length > 0 ? (this.columns[column]?.[this.end - 1] ?? NaN) : NaN;
  }

  /** A column from the row before `from` on, so that a line enters from the left. It is not a copy. */
  column(index: number, from = -Infinity): Float64Array {
    return this.columns[index]!.subarray(Math.max(this.first, this.search(from) - 1), this.end);
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
