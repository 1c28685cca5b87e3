// The registered cars and their incidents of a day, asked from the page's server while somebody looks; a static site knows only the cars that it hears.

import type { Config, IncidentCounts, RobotPresence, RobotsAnswer, TagsAnswer } from "../base/contract";
import { AnswerError, ask } from "../server/answers";

const REFRESH_S = 30;

export class Registry {
  /** Undefined until the server has answered. */
  robots: RobotsAnswer["robots"] | undefined;
  tags: TagsAnswer["tags"] = {};
  private incidents: IncidentCounts["counts"] = {};
  /** Grows with every answer. */
  version = 0;
  private timer: number | undefined;

  constructor(private readonly config: Config) {}

  /** Ask now and every half minute, while a view needs it. */
  watch(needed: boolean): void {
    if (!this.config.answers || needed === (this.timer !== undefined)) return;
    window.clearInterval(this.timer);
    this.timer = undefined;
    if (!needed) return;
    this.refresh();
    this.timer = window.setInterval(() => !document.hidden && this.refresh(), REFRESH_S * 1000);
  }

  presence(robot: string): RobotPresence | undefined {
    return this.robots && Object.hasOwn(this.robots, robot) ? this.robots[robot] : undefined;
  }

  tag(robot: string, name: string): string | undefined {
    return Object.hasOwn(this.tags, robot) ? this.tags[robot]![name] : undefined;
  }

  /** How many incidents of the last day a car has. */
  incidentsOf(robot: string): number {
    return Object.hasOwn(this.incidents, robot) ? this.incidents[robot]! : 0;
  }

  private refresh(): void {
    void this.find();
    // They are counted from the samples of every car, which takes longer.
    void ask<IncidentCounts>("incident_counts", {}).then(
      ({ counts }) => (this.incidents = counts),
      (error: unknown) => {
        if (!(error instanceof AnswerError)) throw error;
      },
    );
  }

  private async find(): Promise<void> {
    // The cars without their tags are better than nothing: their right is another one.
    const asked = [
      ask<RobotsAnswer>("robots", {}).then(({ robots }) => (this.robots = robots)),
      ask<TagsAnswer>("tags", {}).then(({ tags }) => (this.tags = tags)),
    ];
    for (const answer of await Promise.allSettled(asked)) {
      // The cars stay as they were; other views report that the server does not answer.
      if (answer.status === "rejected" && !(answer.reason instanceof AnswerError)) throw answer.reason;
    }
    this.version += 1;
  }
}
