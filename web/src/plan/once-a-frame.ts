/** Does something with the browser's next frame, once however often it was asked. */

export interface Asking {
  ask(): void;
  /** What was asked for is not done any more. */
  cancel(): void;
}

export function onceAFrame(work: () => void): Asking {
  let frame: number | null = null;
  return {
    ask() {
      frame ??= requestAnimationFrame(() => {
        frame = null;
        work();
      });
    },
    cancel() {
      if (frame !== null) cancelAnimationFrame(frame);
      frame = null;
    },
  };
}
