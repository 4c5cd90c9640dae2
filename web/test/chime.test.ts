import { describe, expect, it } from "vitest";

import { type Audio, Chime } from "../src/components/chime";

/** An audio context that a browser holds back until it is let go. */
function bench(state: AudioContextState) {
  const tones: number[] = [];
  let opened = 0;
  let pressed = () => {};
  const part = { connect: () => part, gain: { value: 0 } };
  const audio = {
    state,
    currentTime: 0,
    destination: part,
    resume: () =>
      new Promise<void>((resolve) => {
        pressed = () => {
          audio.state = "running";
          resolve();
        };
      }),
    createOscillator: () => ({
      connect: () => part,
      frequency: { value: 0 },
      start: (at_s: number) => tones.push(at_s),
      stop: () => {},
    }),
    createGain: () => part,
  };
  const chime = new Chime(() => {
    opened += 1;
    return audio as unknown as Audio;
  });
  return { chime, tones, opened: () => opened, press: () => pressed() };
}

describe("the tones of an alert", () => {
  it("come out of one audio context, however many alerts there are", () => {
    const { chime, tones, opened } = bench("running");
    for (let alert = 0; alert < 5; alert += 1) chime.ring();
    expect(opened()).toBe(1);
    expect(tones.length).toBe(10);
  });

  it("are not silently missing while the browser holds them back", async () => {
    const { chime, tones, press } = bench("suspended");
    chime.ring();
    expect(tones.length).toBe(0);
    expect(chime.blocked.value).toBe(true);
    press();
    await Promise.resolve();
    await Promise.resolve();
    expect(chime.blocked.value).toBe(false);
    chime.ring();
    expect(tones.length).toBe(2);
  });
});
