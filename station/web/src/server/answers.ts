// What the server that serves the page answers about the past; see station/iort_station/page/answers.py.

export interface Drive {
  readonly times_s: readonly number[];
  /** For each field its values; least and most too where one row stands for many samples. */
  readonly fields: Readonly<Record<string, { readonly mean: Values; readonly least?: Values; readonly most?: Values }>>;
  readonly samples: number;
  /** Whether charge and energy have the ROS 2 driver's units. */
  readonly ros2: boolean;
  /** What one row covers, in seconds; 0 where each row is a sample. */
  readonly row_s: number;
}

export type Values = readonly (number | string | boolean | null)[];

export interface Series {
  readonly label: string;
  readonly right: boolean;
  readonly times_s: readonly number[];
  readonly values: readonly number[];
}

/** Of every registered car whether it is connected, and since when it is or is not; null if it never was. */
export type Presence = Readonly<Record<string, { readonly online: boolean; readonly since_ms: number | null }>>;

export interface Alarm {
  readonly name: string;
  readonly about: string;
  readonly state: "OK" | "ALARM" | "INSUFFICIENT_DATA";
  readonly reason: string;
  readonly since_s: number;
}

/** What a log widget finds; `found` may be more than there are rows. */
export interface Logs {
  readonly columns: readonly string[];
  readonly rows: readonly (readonly string[])[];
  readonly found: number;
  readonly from_s: number;
  readonly to_s: number;
}

export interface Widget {
  /** Its place in the dashboard's body. */
  readonly number: number;
  readonly x: number;
  readonly y: number;
  readonly width: number;
  readonly height: number;
  readonly title: string;
  readonly kind: "series" | "number" | "alarms" | "log" | "text" | "other";
  readonly text: string;
  readonly period_s: number;
  readonly series: readonly Series[];
  readonly alarms: readonly Alarm[];
}

export interface Dashboard {
  readonly name: string;
  readonly from_s: number;
  readonly to_s: number;
  readonly widgets: readonly Widget[];
}

export class AnswerError extends Error {}

/** Ask the server; raises `AnswerError` with words for the viewer where there is no answer. */
export async function ask<T>(name: string, parameters: Readonly<Record<string, string>>, signal?: AbortSignal): Promise<T> {
  let answer: Response;
  try {
    answer = await fetch(`${name}.json?${new URLSearchParams(parameters).toString()}`, { cache: "no-store", ...(signal ? { signal } : {}) });
  } catch (error) {
    if (signal?.aborted) throw error;
    throw new AnswerError("The page's server does not answer. Is `iort dashboard` still running?");
  }
  const body = (await answer.json().catch(() => ({}))) as { error?: unknown };
  if (!answer.ok) throw new AnswerError(typeof body.error === "string" ? body.error : `The server answered ${answer.status}.`);
  return body as T;
}
