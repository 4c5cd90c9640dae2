import { describe, expect, it } from "vitest";

import { Live, pauseAfter_ms, type WebSocketLike } from "../src/api/live";
import { delta, machineView, snapshot } from "./views";

class FakeSocket implements WebSocketLike {
  onopen: ((event: never) => void) | null = null;
  onmessage: ((event: never) => void) | null = null;
  onclose: ((event: never) => void) | null = null;
  sent: string[] = [];
  closed = false;
  send(text: string) {
    this.sent.push(text);
  }
  close() {
    this.closed = true;
  }
  say(message: unknown) {
    this.onmessage?.({ data: JSON.stringify(message) } as never);
  }
}

/** A connection whose sockets, timers and answers are driven by the test. */
function bench() {
  const sockets: FakeSocket[] = [];
  const timers = new Map<number, { callback: () => void; delay_ms: number }>();
  const log: string[] = [];
  let answers = true;
  let nextTimer = 1;
  const live = new Live(
    {
      snapshot: () => log.push("snapshot"),
      delta: (message) => log.push(`delta ${message.seq}`),
      alerts: (alerts) => log.push(`alerts ${alerts.length}`),
      unreadable: (reason) => log.push(`unreadable ${reason}`),
      lost: (pause_ms) => log.push(`lost ${pause_ms}`),
    },
    {
      open: () => {
        const socket = new FakeSocket();
        sockets.push(socket);
        return socket;
      },
      siteAnswers: async () => answers,
      setTimer: (callback, delay_ms) => {
        timers.set(nextTimer, { callback, delay_ms });
        nextTimer += 1;
        return nextTimer - 1;
      },
      clearTimer: (timer) => void timers.delete(timer),
      random: () => 0.5,
    },
  );
  const fire = async () => {
    for (const [timer, { callback }] of [...timers]) {
      timers.delete(timer);
      callback();
    }
    // The site's answer is a promise.
    await new Promise((resolve) => setTimeout(resolve, 0));
  };
  live.start();
  const socket = () => {
    const last = sockets.at(-1);
    if (last === undefined) throw new Error("no socket was opened");
    return last;
  };
  return { live, sockets, socket, log, fire, silence: () => (answers = false) };
}

describe("the live connection", () => {
  it("asks for its rate and passes snapshot and deltas on", () => {
    const { socket, log } = bench();
    socket().onopen?.({} as never);
    expect(JSON.parse(socket().sent[0] ?? "")).toEqual({ type: "subscribe", rate_hz: 10, alerts: true });
    socket().say(snapshot([machineView()]));
    socket().say(delta(1, [machineView()]));
    expect(log).toEqual(["snapshot", "delta 1"]);
  });

  it("lets gaps pass, because views are whole", () => {
    const { socket, log } = bench();
    socket().say(snapshot([]));
    socket().say(delta(1, []));
    socket().say(delta(5, []));
    expect(log).toEqual(["snapshot", "delta 1", "delta 5"]);
  });

  it("trusts no delta without a snapshot, and none that goes back", async () => {
    const { sockets, socket, log, fire } = bench();
    socket().say(delta(3, []));
    expect(log).toEqual(["lost 250"]);
    await fire();
    expect(sockets.length).toBe(2);
    socket().say(snapshot([]));
    socket().say(delta(2, []));
    socket().say(delta(2, []));
    expect(log.slice(1)).toEqual(["snapshot", "delta 2", "lost 250"]);
  });

  it("connects again after a loss, with growing pauses until a snapshot comes", async () => {
    const { sockets, socket, log, fire } = bench();
    for (let round = 0; round < 3; round += 1) {
      socket().onclose?.({} as never);
      await fire();
    }
    expect(log).toEqual(["lost 250", "lost 500", "lost 1000"]);
    expect(sockets.length).toBe(4);
    socket().say(snapshot([]));
    socket().onclose?.({} as never);
    expect(log.slice(3)).toEqual(["snapshot", "lost 250"]);
  });

  it("does not listen to a socket it has given up", async () => {
    const { sockets, socket, log, fire } = bench();
    const first = socket();
    first.say(snapshot([]));
    first.onclose?.({} as never);
    await fire();
    first.say(delta(1, []));
    first.onclose?.({} as never);
    expect(sockets.length).toBe(2);
    expect(log).toEqual(["snapshot", "lost 250"]);
  });

  it("goes on after a message that it cannot read", () => {
    const { socket, log } = bench();
    socket().say(snapshot([]));
    socket().say({ type: "delta", seq: 1 });
    socket().say(delta(2, []));
    expect(log).toEqual(["snapshot", "unreadable message.time: expected text, found nothing", "delta 2"]);
  });

  it("finds a half-open connection, and leaves a quiet one alone", async () => {
    const { socket, log, fire, silence } = bench();
    socket().say(snapshot([]));
    await fire();
    await fire();
    expect(log).toEqual(["snapshot"]);
    silence();
    await fire();
    expect(log).toEqual(["snapshot"]);
    await fire();
    expect(log).toEqual(["snapshot", "lost 250"]);
    expect(socket().closed).toBe(true);
  });
});

describe("a page that was busy itself", () => {
  it("does not take its own silence for the site's", async () => {
    const { socket, log, fire, silence } = bench();
    socket().say(snapshot([]));
    silence();
    await fire();
    socket().say(delta(1, []));
    await fire();
    expect(log).toEqual(["snapshot", "delta 1"]);
  });
});

describe("pauses", () => {
  it("double up to five seconds, spread by a quarter", () => {
    expect([1, 2, 3, 10].map((failures) => pauseAfter_ms(failures, 0.5))).toEqual([250, 500, 1000, 5000]);
    expect(pauseAfter_ms(10, 0)).toBe(3750);
    expect(pauseAfter_ms(10, 1)).toBe(6250);
  });
});
