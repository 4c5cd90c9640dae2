/**
 * The live connection: a WebSocket that is opened again whenever it is lost, with growing pauses.
 *
 * A connection counts as open when its snapshot has come; what was known before is never carried over. A silent
 * connection is asked about by one plain request, so that a half-open one is found as well.
 */

import { checkLiveMessage, MessageError } from "./check";
import type { Delta, Snapshot } from "./types";

export interface LiveHandlers {
  snapshot(message: Snapshot): void;
  delta(message: Delta): void;
  /** A message that could not be read; the connection goes on. */
  unreadable(reason: string): void;
  /** The connection is gone, or could not be made; the next try follows in `pause_ms`. */
  lost(pause_ms: number): void;
}

/** What the connection needs from the browser; tests give their own. */
export interface LiveSurroundings {
  open(): WebSocketLike;
  /** Whether the site answers a plain request. */
  siteAnswers(): Promise<boolean>;
  setTimer(callback: () => void, delay_ms: number): number;
  clearTimer(timer: number): void;
  /** In [0, 1). */
  random(): number;
}

export interface WebSocketLike {
  onopen: ((event: never) => void) | null;
  onmessage: ((event: never) => void) | null;
  onclose: ((event: never) => void) | null;
  send(text: string): void;
  close(): void;
}

export const RATE_HZ = 10;
const FIRST_PAUSE_MS = 250;
const LONGEST_PAUSE_MS = 5_000;
/** The site sends a delta at least once a second. */
const SILENCE_MS = 3_000;
/** A page that was busy itself finds the messages of that time in this. */
const GRACE_MS = 250;

/** Pause before the next try after `failures` in a row: doubled each time, and spread, so that pages do not come at once. */
export function pauseAfter_ms(failures: number, random: number): number {
  const pause_ms = Math.min(LONGEST_PAUSE_MS, FIRST_PAUSE_MS * 2 ** Math.max(0, failures - 1));
  return pause_ms * (0.75 + 0.5 * random);
}

export class Live {
  private socket: WebSocketLike | null = null;
  private lastSeq: number | null = null;
  private failures = 0;
  private retryTimer: number | null = null;
  private silenceTimer: number | null = null;
  private ended = false;

  constructor(
    private readonly handlers: LiveHandlers,
    private readonly surroundings: LiveSurroundings,
  ) {}

  start(): void {
    this.connect();
  }

  stop(): void {
    this.ended = true;
    if (this.retryTimer !== null) this.surroundings.clearTimer(this.retryTimer);
    this.forget();
  }

  private connect(): void {
    if (this.ended) return;
    const socket = this.surroundings.open();
    this.socket = socket;
    this.lastSeq = null;
    socket.onopen = () => socket.send(JSON.stringify({ type: "subscribe", rate_hz: RATE_HZ }));
    socket.onmessage = (event: { data: unknown }) => this.receive(socket, event.data);
    socket.onclose = () => {
      if (socket === this.socket) this.lose();
    };
    this.watchSilence(socket);
  }

  private receive(socket: WebSocketLike, data: unknown): void {
    if (socket !== this.socket) return;
    this.watchSilence(socket);
    try {
      const message = checkLiveMessage(JSON.parse(String(data)), "message");
      if (message.type === "snapshot") {
        this.lastSeq = message.seq;
        this.failures = 0;
        this.handlers.snapshot(message);
      } else if (message.type === "error") {
        this.handlers.unreadable(message.detail);
      } else if (this.lastSeq === null || message.seq <= this.lastSeq) {
        // Not the stream that the snapshot began: only a new snapshot can be trusted. Gaps are no such case:
        // a slow page is sent the newest whole views, and the ones between are left out.
        this.lose();
      } else {
        this.lastSeq = message.seq;
        // This page does not ask for alerts.
        if (message.type === "delta") this.handlers.delta(message);
      }
    } catch (error) {
      if (!(error instanceof MessageError || error instanceof SyntaxError)) throw error;
      this.handlers.unreadable(error.message);
    }
  }

  private watchSilence(socket: WebSocketLike): void {
    if (this.silenceTimer !== null) this.surroundings.clearTimer(this.silenceTimer);
    this.silenceTimer = this.surroundings.setTimer(() => {
      this.silenceTimer = this.surroundings.setTimer(() => void this.askSite(socket), GRACE_MS);
    }, SILENCE_MS);
  }

  private async askSite(socket: WebSocketLike): Promise<void> {
    const answers = await this.surroundings.siteAnswers();
    if (socket !== this.socket) return;
    // It may be busy; without a snapshot, though, there is nothing to wait for.
    if (answers && this.lastSeq !== null) this.watchSilence(socket);
    else this.lose();
  }

  private lose(): void {
    this.forget();
    if (this.ended) return;
    this.failures += 1;
    const pause_ms = pauseAfter_ms(this.failures, this.surroundings.random());
    this.handlers.lost(pause_ms);
    this.retryTimer = this.surroundings.setTimer(() => this.connect(), pause_ms);
  }

  private forget(): void {
    if (this.silenceTimer !== null) this.surroundings.clearTimer(this.silenceTimer);
    const socket = this.socket;
    this.socket = null;
    socket?.close();
  }
}

/** The connection of a real page to the site that served it. */
export function browserSurroundings(): LiveSurroundings {
  return {
    open: () => new WebSocket(new URL("/api/v1/live", window.location.href.replace(/^http/, "ws"))),
    siteAnswers: async () => {
      try {
        const response = await fetch("/healthz", { cache: "no-store", signal: AbortSignal.timeout(2_000) });
        return response.ok;
      } catch {
        return false;
      }
    },
    setTimer: (callback, delay_ms) => window.setTimeout(callback, delay_ms),
    clearTimer: (timer) => window.clearTimeout(timer),
    random: Math.random,
  };
}
