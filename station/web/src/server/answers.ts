// Questions and requests to the server that serves the page; the answers' types are in contract.ts.

import { KEY_HEADER, type Config } from "../base/contract";

export class AnswerError extends Error {}

type Parameters = Readonly<Record<string, string>>;

/** Ask the server; throws `AnswerError` with a text for the viewer if it does not answer. */
export async function ask<T>(name: string, parameters: Parameters, signal?: AbortSignal): Promise<T> {
  return answered(`${name}.json?${new URLSearchParams(parameters).toString()}`, { cache: "no-store", ...(signal ? { signal } : {}) });
}

/** Have the server change something; throws `AnswerError` if it does not, or if the change is refused. */
export async function act<T>(name: string, parameters: Parameters): Promise<T> {
  // Asked each time, because a server that was started again has another key.
  const { key } = await answered<Config>("config.json", { cache: "no-store" });
  const headers = { "Content-Type": "application/json", [KEY_HEADER]: key };
  return answered(`${name}.json`, { method: "POST", headers, body: JSON.stringify(parameters) });
}

async function answered<T>(address: string, request: RequestInit): Promise<T> {
  let answer: Response;
  try {
    answer = await fetch(address, request);
  } catch (error) {
    if (request.signal?.aborted) throw error;
    throw new AnswerError("The page's server does not answer. Is `iort dashboard` still running?");
  }
  const body = (await answer.json().catch(() => ({}))) as { error?: unknown };
  if (!answer.ok) throw new AnswerError(typeof body.error === "string" ? body.error : `The server answered ${answer.status}.`);
  return body as T;
}
