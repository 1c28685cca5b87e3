// What a viewer sees of a car's camera, without the page: what is asked for over the broker, which of two ways the
// pictures come, and how old the newest one on the screen is.
//
//   ask ─► terms ─► offer ─► answer ─► WebRTC shows a picture
//            │        └─ refused, failed, 5 s without a picture ─┐
//            └──────────────────────────────────────────────────►│ small pictures over the broker; WebRTC is
//                     WebRTC shows nothing new for 5 s ─────────►│ tried again, and they end once it shows a picture
//
// Each WebRTC session has a viewer's name of its own, so that a second one can be tried while the small pictures come,
// and nothing that is sent again fits: an answer counts once, for the request that it repeats.

import { ECHO_EVERY_MS, VIEW_RENEW_S, type VideoTermsEntry } from "../base/contract";
import { DRIFT_MS, Marks, RobotClock } from "./clock";
import {
  askClock,
  decodeClock,
  decodeMarks,
  decodePicture,
  decodeShow,
  encodeLook,
  type IceServer,
  type Look,
  type Show,
  type Topics,
} from "./messages";
import type { Peer, PeerEnds } from "./peer";

// Without an answer, and after a refusal.
const [ASK_AGAIN_MS, REFUSED_MS] = [3_000, 10_000];
// WebRTC has no picture for so long.
export const CONNECT_MS = 5_000;
const STALLED_MS = 5_000;
// WebRTC is tried again: first, and at last.
const [AGAIN_MS, AGAIN_MOST_MS] = [5_000, 60_000];
// Pictures over the broker that are newer by this are shown instead.
const NEWER_MS = 1_000;
// Questions for the clock that may still be answered.
const QUESTIONS = 16;

export type Way = "webrtc" | "broker";

/** What Sight needs of the page. */
export interface Eyes {
  readonly send: (topic: string, message: object) => void;
  readonly hear: (topic: string, heard: boolean) => void;
  /** STUN and TURN servers of the deployment, for a session that begins now. */
  readonly servers: () => Promise<readonly IceServer[]>;
  /** A new WebRTC session; undefined if this browser has none. */
  readonly peer:
    | ((
        servers: readonly IceServer[],
        ends: PeerEnds,
      ) => Pick<Peer, "offer" | "answer" | "send" | "close" | "counts">)
    | undefined;
  /** Draw a JPEG; false if it is none. */
  readonly draw: (jpeg: Uint8Array<ArrayBuffer>) => Promise<boolean>;
  readonly newName: () => string;
  readonly now_ms: () => number;
}

interface Seen {
  readonly number: number;
  readonly captured_ms: number;
  readonly at_ms: number;
}

interface Session {
  readonly viewer: string;
  /** Its newest request, and its newest renewal. */
  request: string;
  kept: string;
  began_ms: number;
  seen: Seen | undefined;
  readonly clock: RobotClock;
}

interface Rtc extends Session {
  readonly peer: ReturnType<NonNullable<Eyes["peer"]>>;
  readonly marks: Marks;
  answered: boolean;
  /** The questions for the clock: number -> when it left. */
  readonly asked: Map<number, number>;
  question: number;
}

interface Small extends Session {
  /** Of all pictures over the broker. */
  bytes: number;
  pictures: number;
}

/** The newest picture on the screen. */
export interface Sighted {
  readonly way: Way;
  readonly number: number;
  /** The most that it can be; undefined before the car's clock is known, and for a picture of the future. */
  readonly age_ms: number | undefined;
  /** How long it has been the newest one. */
  readonly still_ms: number;
}

export class Sight {
  terms: VideoTermsEntry | undefined;
  /** Why no picture comes, for the viewer. */
  words = "";
  /** Why pictures do not come by WebRTC; empty if they do, or if it has not been found out. */
  otherwise = "";
  /** Whether a picture was shown since the viewer looks. */
  had = false;
  private readonly viewer: string;
  private works = false;
  private request = "";
  private asked_ms = -Infinity;
  private askAt_ms = -Infinity;
  private offered: readonly IceServer[] = [];
  /** The round trip of a question over the broker: what is heard of the car took about half of it. */
  private readonly trips = new RobotClock();
  private rtc: Rtc | undefined;
  private small: Small | undefined;
  private rtcAt_ms = -Infinity;
  private again_ms = AGAIN_MS;
  private smallAt_ms = -Infinity;
  private renewed_ms = -Infinity;
  private echoed_ms = -Infinity;
  private dialing = false;
  private decoding = false;
  private closed = false;

  constructor(
    private readonly topics: Topics,
    private readonly eyes: Eyes,
  ) {
    this.viewer = eyes.newName();
    if (!eyes.peer)
      [this.rtcAt_ms, this.otherwise] = [
        Infinity,
        "this browser has no WebRTC, or does not tell which picture it shows",
      ];
  }

  /** The topics to hear from now on. */
  heard(): string[] {
    const { answer, picture } = this.topics;
    return [
      answer(this.viewer),
      ...(this.rtc ? [answer(this.rtc.viewer)] : []),
      ...(this.small ? [picture] : []),
    ];
  }

  /** The connection to the broker works if the reason is empty. */
  connected(reason: string): void {
    this.works = reason === "";
    if (!this.works) this.words = reason;
    else [this.words, this.askAt_ms, this.renewed_ms] = ["Asking the car …", -Infinity, -Infinity];
  }

  hear(topic: string, payload: Uint8Array): void {
    if (this.closed) return;
    if (topic === this.topics.picture) return void this.take(payload);
    const show = decodeShow(payload);
    if (!show) return;
    if (topic === this.topics.answer(this.viewer)) this.told(show);
    if (this.rtc && topic === this.topics.answer(this.rtc.viewer)) this.answered(this.rtc, show);
  }

  /** Ask for what is missing, renew what there is; called often. */
  tick(): void {
    const at = this.eyes.now_ms();
    const { rtc } = this;
    if (rtc && !rtc.seen && at - rtc.began_ms > CONNECT_MS)
      this.fail(rtc, `no picture came within ${CONNECT_MS / 1000} s`);
    // The camera sees, and pictures still come another way.
    if (rtc?.seen && (this.small?.seen?.at_ms ?? 0) - rtc.seen.at_ms > 2 * STALLED_MS)
      this.fail(rtc, `it showed no new picture for ${(2 * STALLED_MS) / 1000} s`);
    if (rtc && at - this.echoed_ms >= ECHO_EVERY_MS) this.question(rtc);
    if (!this.works || this.closed) return;
    // Each answer also tells how long the way over the broker is.
    if (at >= this.askAt_ms) this.ask(at);
    if (this.terms) {
      if (!this.rtc && !this.dialing && at >= this.rtcAt_ms) void this.dial();
      this.instead(at);
    }
    if (at - this.renewed_ms >= VIEW_RENEW_S * 1000) {
      this.renewed_ms = at;
      for (const session of [this.rtc, this.small])
        if (session)
          this.look({ viewer: session.viewer, request: (session.kept = this.eyes.newName()), kind: "keep" });
    }
  }

  /** Undefined while there is none. */
  sighted(): Sighted | undefined {
    const at = this.eyes.now_ms();
    const [rtc, small] = [this.rtc?.seen, this.small?.seen];
    const way = rtc && !(small && small.at_ms > rtc.at_ms + NEWER_MS) ? "webrtc" : "broker";
    const [session, seen] = way === "webrtc" ? [this.rtc!, rtc] : [this.small, small];
    if (!seen) return undefined;
    const { offset_ms, within_ms } = session!.clock;
    // A message over the broker was on its way for no longer than a question and its answer.
    const error_ms = way === "broker" ? this.trips.cost_ms : within_ms;
    const still_ms = at - seen.at_ms;
    const known = offset_ms !== undefined && error_ms !== undefined;
    const age_ms = known ? at + offset_ms + error_ms - seen.captured_ms : undefined;
    return {
      way,
      number: seen.number,
      // The car's clock was set if a picture is of the future. One that stands still is as old as that at least.
      age_ms: age_ms === undefined || age_ms < -DRIFT_MS ? undefined : Math.max(age_ms, still_ms),
      still_ms,
    };
  }

  /** What came of the way that the newest picture took. */
  async counts(): Promise<Awaited<ReturnType<Peer["counts"]>> | undefined> {
    if (this.sighted()?.way === "webrtc") return this.rtc?.peer.counts();
    const { small } = this;
    return (
      small && {
        bytes: small.bytes,
        pictures: small.pictures,
        packets: 0,
        lost: 0,
        rtt_ms: this.trips.cost_ms,
      }
    );
  }

  close(): void {
    this.closed = true;
    for (const session of [this.rtc, this.small]) if (session) this.end(session);
    this.rtc?.peer.close();
    [this.rtc, this.small] = [undefined, undefined];
  }

  private look(look: Look): void {
    this.eyes.send(this.topics.look, encodeLook(look));
  }

  private ask(at: number): void {
    if (!this.terms && this.request !== "") this.words = "The car does not answer";
    [this.request, this.asked_ms] = [this.eyes.newName(), at];
    this.askAt_ms = at + (this.terms ? VIEW_RENEW_S * 1000 : ASK_AGAIN_MS);
    this.look({ viewer: this.viewer, request: this.request, kind: "ask" });
  }

  /** An answer to what the page asked by its first name. */
  private told({ request, kind, why, terms, ice_servers }: Show): void {
    const at = this.eyes.now_ms();
    const { small } = this;
    if (request === this.request) {
      this.request = "";
      this.trips.heard(0, at - this.asked_ms, at);
      if (terms) {
        if (!this.terms) this.words = "Waiting for the first picture …";
        [this.terms, this.offered] = [terms, ice_servers];
      } else if (kind === "refused") {
        // What there is ends by itself.
        [this.terms, this.words, this.askAt_ms] = [
          undefined,
          why || "the car shows nothing",
          at + REFUSED_MS,
        ];
      }
    } else if (small && (request === small.request || request === small.kept) && kind !== "terms") {
      [this.small, this.smallAt_ms] = [undefined, at + (kind === "refused" ? REFUSED_MS : 0)];
      this.eyes.hear(this.topics.picture, false);
      this.words = why || "The car has ended the pictures";
    }
  }

  private async dial(): Promise<void> {
    this.dialing = true;
    // Without them a session may still be possible, directly.
    const deployed = await this.eyes
      .servers()
      .catch((): readonly IceServer[] => [])
      .finally(() => (this.dialing = false));
    if (this.closed || !this.works) return;
    const session = { viewer: this.eyes.newName(), request: this.eyes.newName(), kept: "" };
    const servers = [...deployed, ...this.offered];
    const { ends, known } = this.ends();
    let peer: Rtc["peer"];
    try {
      peer = this.eyes.peer!(servers, ends);
    } catch (error) {
      // An address of a server that is none.
      return this.later(String(error));
    }
    const rtc: Rtc = {
      ...session,
      began_ms: this.eyes.now_ms(),
      seen: undefined,
      clock: new RobotClock(),
      peer,
      marks: new Marks(),
      answered: false,
      asked: new Map(),
      question: 0,
    };
    known(rtc);
    this.rtc = rtc;
    this.eyes.hear(this.topics.answer(rtc.viewer), true);
    try {
      const sdp = await rtc.peer.offer();
      if (this.rtc !== rtc) return;
      const { viewer, request } = rtc;
      const ice_servers = deployed.length > 0 ? { ice_servers: deployed } : {};
      this.look({ viewer, request, kind: "offer", sdp, ...ice_servers });
    } catch (error) {
      this.fail(rtc, String(error));
    }
  }

  /** What a session's connection calls, once the session is known. */
  private ends(): { readonly ends: PeerEnds; readonly known: (rtc: Rtc) => void } {
    let rtc: Rtc | undefined;
    const current = (work: (rtc: Rtc) => void): void => {
      if (rtc && rtc === this.rtc) work(rtc);
    };
    const ends: PeerEnds = {
      open: () => current((one) => this.question(one)),
      message: (message) => current((one) => this.marked(one, message)),
      shown: (rtp) =>
        current((one) => {
          if (rtp !== undefined) return void (one.marks.seen(rtp) && this.saw(one));
          this.fail(one, "this browser does not tell which picture it shows");
          this.rtcAt_ms = Infinity;
        }),
      failed: (why) => current((one) => this.fail(one, why)),
    };
    return { ends, known: (one) => (rtc = one) };
  }

  private answered(rtc: Rtc, { request, kind, why, sdp }: Show): void {
    if (request !== rtc.request && request !== rtc.kept) return;
    if (kind === "refused" || kind === "ended") {
      this.fail(rtc, why || `the car has ${kind} it`);
    } else if (kind === "answer" && request === rtc.request && !rtc.answered) {
      rtc.answered = true;
      rtc.peer.answer(sdp).catch((error: unknown) => this.fail(rtc, String(error)));
    }
  }

  private marked(rtc: Rtc, message: ArrayBuffer): void {
    const at = this.eyes.now_ms();
    const marks = decodeMarks(message);
    if (marks) return void (rtc.marks.heard(marks) && this.saw(rtc));
    const answer = decodeClock(message);
    const left_ms = answer && rtc.asked.get(answer.number);
    if (!answer || left_ms === undefined) return;
    rtc.asked.delete(answer.number);
    const trip_ms = at - left_ms;
    rtc.clock.heard(answer.robot_ms - (left_ms + at) / 2, trip_ms, at, trip_ms / 2);
  }

  private question(rtc: Rtc): void {
    this.echoed_ms = this.eyes.now_ms();
    rtc.asked.set((rtc.question += 1), this.echoed_ms);
    for (const old of rtc.asked.keys()) if (rtc.asked.size > QUESTIONS) rtc.asked.delete(old);
    rtc.peer.send(askClock(rtc.question));
  }

  private saw(rtc: Rtc): void {
    const { number, captured_ms } = rtc.marks.shown!;
    rtc.seen = { number, captured_ms, at_ms: this.eyes.now_ms() };
    [this.otherwise, this.again_ms, this.words, this.had] = ["", AGAIN_MS, "", true];
  }

  /** Give a WebRTC session up, and try another later. */
  private fail(rtc: Rtc, why: string): void {
    if (this.rtc !== rtc) return;
    this.end(rtc);
    rtc.peer.close();
    this.rtc = undefined;
    if (rtc.seen) this.words = "The picture is gone, and is asked for again …";
    this.later(why);
  }

  /** Try WebRTC again, with more patience each time. */
  private later(why: string): void {
    this.otherwise = why;
    this.rtcAt_ms = this.eyes.now_ms() + this.again_ms;
    this.again_ms = Math.min(2 * this.again_ms, AGAIN_MOST_MS);
  }

  private end(session: Session): void {
    const { viewer } = session;
    if (this.works) this.look({ viewer, request: this.eyes.newName(), kind: "end" });
    this.eyes.hear(session === this.small ? this.topics.picture : this.topics.answer(viewer), false);
  }

  /** Have small pictures over the broker while WebRTC shows none. */
  private instead(at: number): void {
    const shows = this.rtc?.seen && at - this.rtc.seen.at_ms <= STALLED_MS;
    if (this.small && shows) {
      this.end(this.small);
      this.small = undefined;
    }
    if (shows || (this.otherwise === "" && !this.rtc?.seen)) return;
    if (!this.small) {
      if (at < this.smallAt_ms) return;
      this.eyes.hear(this.topics.picture, true);
      const { viewer } = this;
      const none = { seen: undefined, clock: new RobotClock(), bytes: 0, pictures: 0 };
      this.small = { viewer, request: "", kept: "", began_ms: -Infinity, ...none };
    }
    const { small } = this;
    if (at - Math.max(small.began_ms, small.seen?.at_ms ?? -Infinity) <= ASK_AGAIN_MS) return;
    [small.request, small.began_ms] = [this.eyes.newName(), at];
    this.look({ viewer: small.viewer, request: small.request, kind: "pictures" });
  }

  private async take(payload: Uint8Array): Promise<void> {
    const { small } = this;
    const picture = decodePicture(payload);
    if (!small || !picture) return;
    const at = this.eyes.now_ms();
    small.bytes += payload.length;
    small.pictures += 1;
    small.clock.heard(picture.sent_ms - at, at - picture.sent_ms, at);
    // One that is older than what is shown, or that comes while another is decoded, is left out.
    // After a while an older one is shown, too, with its age: the car's clock may have been set back.
    const newest = at - (small.seen?.at_ms ?? -Infinity) < ASK_AGAIN_MS ? small.seen : undefined;
    if (this.decoding || (newest && picture.captured_ms <= newest.captured_ms)) return;
    this.decoding = true;
    const drawn = await this.eyes.draw(picture.jpeg).finally(() => (this.decoding = false));
    if (!drawn || small !== this.small) return;
    const { number, captured_ms } = picture;
    small.seen = { number, captured_ms, at_ms: this.eyes.now_ms() };
    [this.words, this.had] = ["", true];
  }
}
