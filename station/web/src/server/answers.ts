// Questions to the server that serves the page; the answers' types are in contract.ts.

export class AnswerError extends Error {}

/** Ask the server; throws `AnswerError` with a text for the viewer if it does not answer. */
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
