// Saves a range as a file of one of the server's formats.

import { button, el, Text } from "../base/dom";
import { Latest } from "../server/answers";
import { save } from "../widgets/saving";

const FORMATS = { csv: "CSV", parquet: "Parquet", mcap: "MCAP" } as const;

export class Download {
  readonly node: HTMLElement;
  private readonly note = new Text("note", "span", { role: "status" });
  private readonly loading = new Latest();

  /** `asked` gives the parameters of the request. */
  constructor(private readonly asked: () => Readonly<Record<string, string>>) {
    const buttons = Object.entries(FORMATS).map(([format, label]) => {
      const title = `Every field and sample of the range, as ${label}`;
      return button(label, () => this.save(format), { title });
    });
    this.node = el("p", { class: "download" }, "Download ", ...buttons, this.note.node);
  }

  private save(format: string): void {
    this.note.set("Reading the samples …");
    void save(`history.${format}`, this.asked(), this.note, this.loading);
  }
}
