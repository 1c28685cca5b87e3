// The server's key, without which a browser may only look. It comes once, for the token in the address that the
// server's terminal shows, and is kept in this browser.

import { type Admitted, type Config, INVITATION } from "../base/contract";
import { keep, kept } from "../base/kept";
import { AnswerError, act, KEPT_KEY } from "./answers";

const IN_ADDRESS = new RegExp(`[?&]${INVITATION}=([\\w-]+)`);
let admitted = false;
// Why the server gave this browser no key.
let refusal = "this page was opened without a link that lets it act";

/** Whether an address has a token. */
export const invited = (hash: string): boolean => IN_ADDRESS.test(hash);

/** Take the token out of the address; without a good one, see if the kept key is still the server's. */
export async function enter(config: Config): Promise<void> {
  const tokens = [IN_ADDRESS.exec(location.hash)?.[1], kept(KEPT_KEY)];
  history.replaceState(null, "", location.hash.replace(IN_ADDRESS, ""));
  if (config.keyed.length === 0) return;
  for (const token of tokens) {
    if (!token || admitted) continue;
    try {
      const { key } = await act<Admitted>("key", { token });
      keep(KEPT_KEY, key);
      admitted = true;
    } catch (error) {
      if (!(error instanceof AnswerError)) throw error;
      // The page is for looking, then, and says why.
      refusal = error.message;
    }
  }
}

/** Whether the server takes an action, and takes it from this browser. */
export const may = (config: Config, action: string): boolean =>
  config.actions.includes(action) && (admitted || !config.keyed.includes(action));

/** Why this browser may only look; empty if it may act, or if nobody may. */
export const readOnly = (config: Config): string => (admitted || config.keyed.length === 0 ? "" : refusal);
