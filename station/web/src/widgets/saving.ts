// Saves a file of the page's server, and says how far it is.

import { el, type Text } from "../base/dom";
import { bytes } from "../live/attachments";
import { download, type Latest } from "../server/answers";

/** Ask for a file and give it to the browser; `note` says how much has come, and why it fails. */
export async function save(
  name: string,
  asked: Readonly<Record<string, string>>,
  note: Pick<Text, "set">,
  loading: Latest,
): Promise<void> {
  const received = (size: number): void => note.set(`${bytes(size)} …`);
  await loading.run(
    async (signal) => {
      const { content, name: saved } = await download(name, asked, received, signal);
      const address = URL.createObjectURL(content);
      el("a", { href: address, download: saved }).click();
      // The browser takes its own hold of the content when it begins to save it.
      window.setTimeout(() => URL.revokeObjectURL(address), 60_000);
      note.set(`${saved}, ${bytes(content.size)}`);
    },
    (reason) => note.set(reason),
  );
}
