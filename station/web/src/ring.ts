/**
 * The newest `capacity` rows of numbers, in columns that never grow. Each column is twice as long as
 * needed, so that the rows always lie side by side: when the end is reached, they move to the front.
 */
export class Ring {
  private readonly columns: Float64Array[];
  private first = 0;
  private end = 0;

  constructor(
    width: number,
    private readonly capacity: number,
  ) {
    this.columns = Array.from({ length: width }, () => new Float64Array(2 * capacity));
  }

  get length(): number {
    return this.end - this.first;
  }

  push(...row: number[]): void {
    if (this.end === 2 * this.capacity) {
      for (const column of this.columns) column.copyWithin(0, this.first, this.end);
      this.end -= this.first;
      this.first = 0;
    }
    this.columns.forEach((column, i) => (column[this.end] = row[i] ?? NaN));
    this.end += 1;
    if (this.length > this.capacity) this.first += 1;
  }

  clear(): void {
    this.first = this.end = 0;
  }

  /** The newest value of a column, NaN where there is none. */
  last(column: number): number {
    return this.length > 0 ? (this.columns[column]?.[this.end - 1] ?? NaN) : NaN;
  }

  /** A column from the row before `from` on (so that a line enters from the left); no copy. */
  column(index: number, from = -Infinity): Float64Array {
    return this.columns[index]!.subarray(Math.max(this.first, this.search(from) - 1), this.end);
  }

  /** The first row whose first column, which only grows, is at least `from`. */
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
