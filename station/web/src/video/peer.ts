// A WebRTC session with a car: its pictures on a video element, and the data channel of their marks. The offer goes out
// with all its candidates. Nothing is buffered: a picture is shown when it comes, not when it would look smooth.

import { CHANNEL } from "../base/contract";
import type { IceServer } from "./messages";

// Candidates that come later are left out: a server that does not answer must not hold back those that are there.
const GATHER_MS = 1_000;

export interface PeerEnds {
  readonly message: (message: ArrayBuffer) => void;
  /** The channel is open: questions are answered. */
  readonly open: () => void;
  /** A picture is on the screen; its RTP timestamp, undefined if the browser does not tell it. */
  readonly shown: (rtp: number | undefined) => void;
  readonly failed: (why: string) => void;
}

/** What the browser has counted since the session began. */
export interface Counts {
  readonly bytes: number;
  readonly pictures: number;
  readonly packets: number;
  readonly lost: number;
  readonly rtt_ms: number | undefined;
}

/** Whether this browser has WebRTC, and tells which picture it shows. */
export const able = (): boolean =>
  "RTCPeerConnection" in window && "requestVideoFrameCallback" in HTMLVideoElement.prototype;

export class Peer {
  private readonly connection: RTCPeerConnection;
  private readonly channel: RTCDataChannel;
  private closed = false;

  constructor(
    servers: readonly IceServer[],
    private readonly video: HTMLVideoElement,
    private readonly ends: PeerEnds,
  ) {
    const iceServers = servers.map((server) => ({ ...server, urls: [...server.urls] }));
    const connection = new RTCPeerConnection({ iceServers, bundlePolicy: "max-bundle" });
    this.connection = connection;
    connection.addTransceiver("video", { direction: "recvonly" });
    this.channel = connection.createDataChannel(CHANNEL, { ordered: false, maxRetransmits: 0 });
    this.channel.binaryType = "arraybuffer";
    this.channel.onopen = () => ends.open();
    this.channel.onmessage = ({ data }) => data instanceof ArrayBuffer && !this.closed && ends.message(data);
    connection.ontrack = ({ receiver, track }) => this.show(receiver, track);
    connection.onconnectionstatechange = () =>
      !this.closed && connection.connectionState === "failed" && ends.failed("the connection failed");
  }

  /** The session description to send. */
  async offer(): Promise<string> {
    const { connection } = this;
    await connection.setLocalDescription();
    if (connection.iceGatheringState !== "complete")
      await new Promise<void>((done) => {
        window.setTimeout(done, GATHER_MS);
        connection.onicegatheringstatechange = () => connection.iceGatheringState === "complete" && done();
      });
    return connection.localDescription?.sdp ?? "";
  }

  async answer(sdp: string): Promise<void> {
    await this.connection.setRemoteDescription({ type: "answer", sdp });
  }

  send(message: ArrayBuffer): void {
    if (this.channel.readyState === "open") this.channel.send(message);
  }

  async counts(): Promise<Counts> {
    let counts: Counts = { bytes: 0, pictures: 0, packets: 0, lost: 0, rtt_ms: undefined };
    for (const each of (await this.connection.getStats()).values() as Iterable<Record<string, number>>) {
      const { type, kind, nominated } = each as Readonly<Record<string, unknown>>;
      if (type === "inbound-rtp" && kind === "video")
        counts = {
          ...counts,
          bytes: each.bytesReceived ?? 0,
          pictures: each.framesDecoded ?? 0,
          packets: each.packetsReceived ?? 0,
          lost: each.packetsLost ?? 0,
        };
      if (type === "candidate-pair" && nominated === true && each.currentRoundTripTime !== undefined)
        counts = { ...counts, rtt_ms: each.currentRoundTripTime * 1e3 };
    }
    return counts;
  }

  close(): void {
    this.closed = true;
    this.connection.close();
    this.video.srcObject = null;
  }

  private show(receiver: RTCRtpReceiver, track: MediaStreamTrack): void {
    // The newer name, and Chromium's older one.
    if ("jitterBufferTarget" in receiver) receiver.jitterBufferTarget = 0;
    if ("playoutDelayHint" in receiver) receiver.playoutDelayHint = 0;
    const { video } = this;
    video.srcObject = new MediaStream([track]);
    const shown = (_now: number, { rtpTimestamp }: VideoFrameCallbackMetadata): void => {
      if (this.closed) return;
      video.requestVideoFrameCallback(shown);
      this.ends.shown(rtpTimestamp);
    };
    video.requestVideoFrameCallback(shown);
    // A muted video may play by itself; where it may not, no picture comes, and pictures over the broker do.
    const play = (): void => void video.play().catch(() => undefined);
    // A browser that saves power may pause it.
    video.onpause = () => !this.closed && play();
    play();
  }
}
