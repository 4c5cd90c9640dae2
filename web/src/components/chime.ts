/** Two short tones for a new alert, out of one audio context: a browser holds it back until a person pressed something. */

import { type ReadonlySignal, signal } from "@preact/signals";

/** What is needed of an `AudioContext`. */
export type Audio = Pick<
  AudioContext,
  "state" | "resume" | "currentTime" | "destination" | "createOscillator" | "createGain"
>;

const TONES_HZ = [660, 880] as const;
const STEP_S = 0.2;
const TONE_S = 0.16;
const LEVEL = 0.08;

export class Chime {
  private audio: Audio | null = null;
  private readonly held = signal(false);

  constructor(private readonly open: () => Audio) {}

  /** Whether nothing would be heard, because the browser waits for a press. */
  get blocked(): ReadonlySignal<boolean> {
    return this.held;
  }

  /** Makes ready to be heard; to be called again when a person pressed something. */
  wake(): void {
    this.audio ??= this.open();
    const { audio } = this;
    const held = audio.state !== "running";
    this.held.value = held;
    if (!held) return;
    // While it is held back this stays unanswered, for ever if need be.
    void audio.resume().then(
      () => {
        this.held.value = audio.state !== "running";
      },
      () => {},
    );
  }

  /** Nobody wants to hear anything: it does not matter whether one could. */
  rest(): void {
    this.held.value = false;
  }

  ring(): void {
    this.wake();
    const { audio } = this;
    // Tones that were held back would come out late, and all at once.
    if (audio === null || audio.state !== "running") return;
    for (const [index, hertz] of TONES_HZ.entries()) {
      const tone = audio.createOscillator();
      const level = audio.createGain();
      tone.frequency.value = hertz;
      level.gain.value = LEVEL;
      tone.connect(level).connect(audio.destination);
      tone.start(audio.currentTime + index * STEP_S);
      tone.stop(audio.currentTime + index * STEP_S + TONE_S);
    }
  }
}
