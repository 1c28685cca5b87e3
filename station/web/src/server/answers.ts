// Questions and requests to the server that serves the page; the answers' types are in contract.ts.

import { KEY_HEADER } from "../base/contract";
import { kept } from "../base/kept";
import { AT_ONCE, laneOf } from "./lanes";

/** The server's key, as this browser keeps it: see admission.ts. */
export const KEPT_KEY = "key";

export class AnswerError extends Error {}

/** What a viewer is told of a failure. */
export const words = (error: unknown): string =>
  error instanceof AnswerError ? error.message : String(error);

/** Of several tasks in a row only the newest counts: an older one is ended, and its failure says nothing. */
export class Latest {
  private current = new AbortController();

  stop(): void {
    this.current.abort();
  }

  async run(work: (signal: AbortSignal) => Promise<void>, failed: (reason: string) => void): Promise<void> {
    this.stop();
    const { signal } = (this.current = new AbortController());
    try {
      await work(signal);
    } catch (error) {
      if (!signal.aborted) failed(words(error));
    }
  }
}

type Parameters = Readonly<Record<string, string>>;

/**
 * Ask the server; throws `AnswerError` with a text for the viewer if it does not answer. The browser may keep what does
 * not change (`no-cache`: it asks whether it has changed).
 */
export async function ask<T>(
  name: string,
  parameters: Parameters,
  signal?: AbortSignal,
  cache: RequestCache = "no-store",
): Promise<T> {
  const answer = await laneOf(name).run(
    async (end) => (await (await get(`${name}.json`, parameters, end, cache)).json()) as T,
    signal,
  );
  signal?.throwIfAborted();
  return answer;
}

/**
 * Have the server change something, with `keepalive` even if the page is closed meanwhile. Throws `AnswerError` if it
 * does not, or if the change is refused.
 */
export function act<T>(
  name: string,
  parameters: Parameters,
  { keepalive = false, signal }: { readonly keepalive?: boolean; readonly signal?: AbortSignal } = {},
): Promise<T> {
  const headers = { "Content-Type": "application/json", [KEY_HEADER]: kept(KEPT_KEY) ?? "" };
  const request: RequestInit = {
    method: "POST",
    priority: "high",
    keepalive,
    headers,
    body: JSON.stringify(parameters),
  };
  // The last word of a page that is closed cannot wait.
  const lane = keepalive ? AT_ONCE : laneOf(name);
  return lane.run(
    async (end) =>
      (await (await answered(`${name}.json`, { ...request, ...(end ? { signal: end } : {}) })).json()) as T,
    signal,
  );
}

/** Ask for a file, and report the bytes received; throws `AnswerError` also if the file is cut off. */
export function download(
  name: string,
  parameters: Parameters,
  received: (size: number) => void,
  signal: AbortSignal,
): Promise<Downloaded> {
  return laneOf(name).run(() => downloaded(name, parameters, received, signal), signal);
}

interface Downloaded {
  readonly content: Blob;
  readonly name: string;
}

async function downloaded(
  name: string,
  parameters: Parameters,
  received: (size: number) => void,
  signal: AbortSignal,
): Promise<Downloaded> {
  const answer = await get(name, parameters, signal);
  const parts: Uint8Array<ArrayBuffer>[] = [];
  let size = 0;
  try {
    for (const reader = answer.body!.getReader(); ; ) {
      const { done, value } = await reader.read();
      if (done) break;
      parts.push(value);
      received((size += value.length));
    }
  } catch (error) {
    if (signal.aborted) throw error;
    throw new AnswerError(
      "The download was cut off, and nothing was saved. The server's terminal has the reason.",
    );
  }
  const named = /filename="([^"]+)"/.exec(answer.headers.get("Content-Disposition") ?? "")?.[1];
  return { content: new Blob(parts), name: named ?? name };
}

function get(
  name: string,
  parameters: Parameters,
  signal: AbortSignal | undefined,
  cache: RequestCache = "no-store",
): Promise<Response> {
  return answered(`${name}?${new URLSearchParams(parameters).toString()}`, {
    cache,
    ...(signal ? { signal } : {}),
  });
}

async function answered(address: string, request: RequestInit): Promise<Response> {
  let answer: Response;
  try {
    answer = await fetch(address, request);
  } catch (error) {
    if (request.signal?.aborted && !isTimeout(request.signal.reason)) throw error;
    throw new AnswerError("The page's server does not answer. Is it still running?");
  }
  if (answer.ok) return answer;
  const body = (await answer.json().catch(() => ({}))) as { error?: unknown };
  throw new AnswerError(
    typeof body.error === "string" ? body.error : `The server answered ${answer.status}.`,
  );
}

const isTimeout = (reason: unknown): boolean =>
  reason instanceof DOMException && reason.name === "TimeoutError";
