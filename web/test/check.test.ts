import { describe, expect, it } from "vitest";

import { checkEvents, checkLiveMessage, checkSessions } from "../src/api/check";
import { delta, machineView, poseView, snapshot, TIME } from "./views";

/** As it arrives: through JSON. */
const arrive = (message: unknown) => checkLiveMessage(JSON.parse(JSON.stringify(message)), "message");

describe("messages on arrival", () => {
  it("come through whole when they are right", () => {
    expect(arrive(snapshot([machineView()]))).toEqual(snapshot([machineView()]));
    expect(arrive(delta(7, [machineView({ pose: null, health: null })]))).toEqual(
      delta(7, [machineView({ pose: null, health: null })]),
    );
  });

  it("may hold fields from a newer site", () => {
    expect(arrive({ ...delta(1, []), novelty: 3 })).toEqual(delta(1, []));
  });

  it("are refused with the path of the wrong field", () => {
    const broken = machineView({ pose: { ...poseView(), position_m: [1, 2] as never } });
    expect(() => arrive(delta(1, [machineView(), broken]))).toThrow(
      "message.machines[1].pose.position_m: expected three numbers, found [1,2]",
    );
  });

  it("are refused when a number is missing or not finite", () => {
    expect(() => arrive(delta(1, [machineView({ pose: poseView({ age_s: Number.NaN }) })]))).toThrow(
      "pose.age_s: expected a number, found null",
    );
    expect(() => arrive({ type: "delta", machines: [] })).toThrow(
      "message.seq: expected a number, found nothing",
    );
  });

  it("are refused when a word is not one of those agreed", () => {
    expect(() => arrive(delta(1, [machineView({ severity: "splendid" as never })]))).toThrow(
      "severity: expected one of good, warning, bad, offline",
    );
    expect(() => arrive({ type: "gossip" })).toThrow(
      'message.type: expected "snapshot", "delta", "alerts" or "error"',
    );
    expect(() => arrive([])).toThrow("message: expected an object");
  });

  it("are refused when a time cannot be read", () => {
    expect(() => arrive({ ...delta(1, []), time: "yesterday" })).toThrow(
      "message.time: expected an RFC 3339 time",
    );
  });
});

describe("events", () => {
  const arriving = (event: unknown) =>
    checkEvents({ session: "s", events: [{ time: TIME, machine: "a", event }], left_out: 0 }, "answer");
  const head = { stamp_ns: 7, severity: "warning" };

  it("have the fields of their kind, and no others", () => {
    const began = { ...head, kind: "outage_began", cause: "silent" };
    expect(arriving({ ...began, novelty: 1 }).events[0]?.event).toEqual(began);
    const ended = {
      ...head,
      kind: "outage_ended",
      start_stamp_ns: 1,
      end_stamp_ns: 5,
      cause: "frozen",
      travelled_m: 3.5,
      jump_m: null,
    };
    expect(arriving(ended).events[0]?.event).toEqual(ended);
  });

  it("are refused when a field of their kind is missing or wrong", () => {
    expect(() => arriving({ ...head, kind: "outage_began" })).toThrow("events[0].event.cause");
    expect(() => arriving({ ...head, kind: "mode_changed", from: "main", to: "sideways" })).toThrow(
      "event.to: expected one of",
    );
    expect(() => arriving({ ...head, kind: "refused", sensor: "imu", reason: "late" })).toThrow(
      "event.count",
    );
    expect(() => arriving({ ...head, severity: "bad", kind: "restarted", reason: "" })).toThrow(
      "event.severity",
    );
  });
});

describe("the list of recordings", () => {
  it("is checked as well", () => {
    const session = {
      id: "s",
      name: "",
      notes: "",
      tags: [],
      state: "recording",
      started: "2026-11-23T05:00:00Z",
      ended: null,
      bytes: 12,
      messages: 3,
      machines: ["a"],
      files: 1,
    };
    const recording = {
      state: "paused",
      why: "the disk is full",
      session: "s",
      missed: 3,
      next_session: null,
    };
    expect(checkSessions({ recording, sessions: [session], next: null }, "sessions")).toEqual({
      recording,
      sessions: [session],
      next: null,
    });
    expect(() =>
      checkSessions({ recording, sessions: [{ ...session, state: "lost" }], next: null }, "sessions"),
    ).toThrow("sessions.sessions[0].state");
    expect(() =>
      checkSessions({ recording: { ...recording, why: 1 }, sessions: [], next: null }, "sessions"),
    ).toThrow("sessions.recording.why");
  });
});
