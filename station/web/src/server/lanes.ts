// Who waits for whom on the way to the page's server.
//
// A browser opens at most six connections to a server, and all its tabs and workers share them: six slow answers would
// hold back a stop. So reading has four of them at most, what must be renewed soon has one, and nothing else ever waits:
// a stop, a release and the way to the wheel always find a connection. The places are locks of the browser, which its
// tabs share; a browser has none for a page over plain HTTP from another computer, where each page counts its own.

/** Ends the hold of a place. */
type Free = () => void;
type Work<T> = (signal: AbortSignal | undefined) => Promise<T>;

class Lane {
  private free: number;
  private readonly waiting: (() => void)[] = [];

  /** Who has a place keeps it for `most_ms` at most. */
  constructor(
    private readonly name: string,
    private readonly places: number,
    private readonly most_ms?: number,
  ) {
    this.free = places;
  }

  /** Do this once there is a place; throws the signal's reason if that comes first. */
  async run<T>(work: Work<T>, signal?: AbortSignal): Promise<T> {
    const free = await ("locks" in navigator ? this.shared(signal) : this.own(signal));
    try {
      return await work(
        this.most_ms === undefined
          ? signal
          : AbortSignal.any([...(signal ? [signal] : []), AbortSignal.timeout(this.most_ms)]),
      );
    } finally {
      free();
    }
  }

  /** Wait at every place, and take the first that is free. */
  private shared(signal: AbortSignal | undefined): Promise<Free> {
    const others = new AbortController();
    const end = signal ? AbortSignal.any([signal, others.signal]) : others.signal;
    return new Promise((taken, failed) => {
      let has = false;
      const take = (): Promise<void> | undefined => {
        if (has) return undefined;
        has = true;
        others.abort();
        return new Promise((free) => taken(free));
      };
      for (let place = 0; place < this.places; place += 1) {
        navigator.locks
          .request(`iort.${this.name}.${place}`, { signal: end }, take)
          .catch((error: unknown) => !has && failed(error));
      }
    });
  }

  private async own(signal: AbortSignal | undefined): Promise<Free> {
    while (this.free === 0) await new Promise<void>((next) => this.waiting.push(next));
    const free = (): void => {
      this.free += 1;
      this.waiting.shift()?.();
    };
    this.free -= 1;
    if (!signal?.aborted) return free;
    free();
    throw signal.reason;
  }
}

const READING = new Lane("read", 4);
const SOON = new Lane("soon", 1, 5_000);
export const AT_ONCE = { run: <T>(work: Work<T>, signal?: AbortSignal): Promise<T> => work(signal) };

// The rest is reading, or takes its time as reading does.
const LANES: Readonly<Record<string, Pick<Lane, "run">>> = {
  stop: AT_ONCE,
  drive: AT_ONCE,
  key: AT_ONCE,
  motion: SOON,
  view: SOON,
  socket: SOON,
};

export const laneOf = (name: string): Pick<Lane, "run"> =>
  Object.hasOwn(LANES, name) ? LANES[name]! : READING;
