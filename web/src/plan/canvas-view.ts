/**
 * The plan on a canvas: ground, what lies under the machines, grid, machines. No WebGL, and no tiles unless the site has
 * a basemap: it draws everywhere, and fast enough where graphics are done by the processor.
 *
 * What moves is drawn at most once a frame; what seldom changes is kept as paths in metres. Drag, wheel, two
 * fingers and keys move it.
 */

import type { Metres } from "../geometry/geodesy";
import type { Extent, GridLine } from "../geometry/grid";
import { onceAFrame } from "./once-a-frame";
import type { Palette } from "./palette";
import {
  type Backdrop,
  LAYERS,
  type PlanEvents,
  type PlanView,
  type PlanWord,
  type Shape,
  type Underlay,
} from "./view";

const METRES_PER_PIXEL_MIN = 0.0015;
const METRES_PER_PIXEL_MAX = 60;
/** Fitting two machines side by side goes no closer than this. */
const FIT_METRES_PER_PIXEL_MIN = 0.011;
const EDGE_PX = 56;
/** An arrow key moves the plan by this. */
const KEY_STEP_PX = 80;
/** A press that moved less is a press. */
const PRESS_PX = 5;
/** Sharper than this is not seen, and costs. */
const PIXEL_RATIO_MAX = 2;
/** Words of the plan are left out where a metre is smaller. */
const WORDS_FROM_M_PER_PX = 0.6;

export function createCanvasView(
  container: HTMLElement,
  palette: Palette,
  label: string,
  events: PlanEvents,
): PlanView {
  const canvas = document.createElement("canvas");
  canvas.className = "plan-drawing";
  canvas.tabIndex = 0;
  canvas.setAttribute("role", "application");
  canvas.setAttribute("aria-label", label);
  container.append(canvas);
  // The ground covers everything: no pixel below has to be mixed in.
  const context = canvas.getContext("2d", { alpha: false });
  if (context === null) throw new Error("this browser does not draw");

  let centre: Metres = [0, 0];
  let metresPerPixel = 0.1;
  let colours = palette;
  let shapes: readonly Shape[] = [];
  let grid: readonly GridLine[] = [];
  let underlays: readonly Underlay[] = [];
  let words: readonly PlanWord[] = [];
  let backdrop: Backdrop | null = null;
  let width = 1;
  let height = 1;
  let ratio = 1;

  const printing = window.matchMedia("print");

  const toPixels = ([east, north]: Metres): readonly [number, number] => [
    width / 2 + (east - centre[0]) / metresPerPixel,
    height / 2 - (north - centre[1]) / metresPerPixel,
  ];
  const toMetres = (x: number, y: number): Metres => [
    centre[0] + (x - width / 2) * metresPerPixel,
    centre[1] - (y - height / 2) * metresPerPixel,
  ];
  const { ask, cancel } = onceAFrame(() => paint());

  const paint = () => {
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.globalAlpha = 1;
    context.fillStyle = colours.ground;
    context.fillRect(0, 0, width, height);
    paintBackdrop();
    paintUnderlays();
    paintGrid();
    paintWords();
    context.lineJoin = "round";
    context.lineCap = "round";
    for (const layer of LAYERS) for (const shape of shapes) if (shape.layer === layer) paintShape(shape);
  };
  const paintBackdrop = () => {
    // On paper it costs ink, and the words above it are hard to read.
    if (backdrop === null || printing.matches) return;
    context.globalAlpha = colours.backdropOpacity;
    backdrop.paint(context, { centre, metresPerPixel, width_px: width, height_px: height, ratio });
    context.globalAlpha = 1;
  };
  const paintUnderlays = () => {
    const scale = 1 / metresPerPixel;
    const [x, y] = toPixels([0, 0]);
    for (const under of underlays) {
      context.setTransform(ratio * scale, 0, 0, -ratio * scale, ratio * x, ratio * y);
      if (under.fill !== undefined) {
        context.globalAlpha = under.fillOpacity ?? 1;
        context.fillStyle = under.fill;
        context.fill(under.path);
      }
      if (under.stroke !== undefined) {
        context.globalAlpha = 1;
        context.strokeStyle = under.stroke;
        context.lineWidth = (under.strokeWidth_px ?? 1) * metresPerPixel;
        context.stroke(under.path);
      }
    }
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.globalAlpha = 1;
  };
  const paintGrid = () => {
    context.lineWidth = 1;
    for (const major of [false, true]) {
      context.beginPath();
      for (const line of grid) {
        if (line.major !== major) continue;
        const [x0, y0] = toPixels(line.from);
        const [x1, y1] = toPixels(line.to);
        context.moveTo(Math.round(x0) + 0.5, Math.round(y0) + 0.5);
        context.lineTo(Math.round(x1) + 0.5, Math.round(y1) + 0.5);
      }
      context.strokeStyle = major ? colours.gridMajor : colours.gridMinor;
      context.stroke();
    }
  };
  const paintWords = () => {
    if (words.length === 0 || metresPerPixel > WORDS_FROM_M_PER_PX) return;
    context.font = "600 12px sans-serif";
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.lineWidth = 3;
    context.strokeStyle = colours.ground;
    context.fillStyle = colours.planInk;
    for (const { at, text } of words) {
      const [x, y] = toPixels(at);
      context.strokeText(text, x, y);
      context.fillText(text, x, y);
    }
  };
  const paintShape = (shape: Shape) => {
    const { points } = shape;
    context.beginPath();
    let drawnX = Number.NaN;
    let drawnY = Number.NaN;
    let inSight = false;
    for (let index = 0; index < points.length; index += 1) {
      const point = points[index] as Metres;
      const x = width / 2 + (point[0] - centre[0]) / metresPerPixel;
      const y = height / 2 - (point[1] - centre[1]) / metresPerPixel;
      inSight ||= x > -50 && y > -50 && x < width + 50 && y < height + 50;
      if (index === 0) context.moveTo(x, y);
      // Steps below a pixel are not seen, but a long tail has many of them.
      else if (Math.abs(x - drawnX) + Math.abs(y - drawnY) < 0.7 && index < points.length - 1) continue;
      else context.lineTo(x, y);
      drawnX = x;
      drawnY = y;
    }
    if (!inSight && points.length < 200) return;
    if (shape.kind === "area") context.closePath();
    if (shape.fill !== undefined) {
      context.globalAlpha = shape.fillOpacity ?? 1;
      context.fillStyle = shape.fill;
      context.fill();
    }
    if (shape.stroke !== undefined) {
      context.globalAlpha = shape.strokeOpacity ?? 1;
      context.strokeStyle = shape.stroke;
      context.lineWidth = shape.strokeWidth_px ?? 1;
      context.stroke();
    }
  };

  const moved = () => {
    events.moved();
    ask();
  };
  const shift = (right_px: number, down_px: number) => {
    centre = [centre[0] - right_px * metresPerPixel, centre[1] + down_px * metresPerPixel];
    moved();
  };
  /** What is at these pixels stays there. */
  const zoomAt = (factor: number, x: number, y: number) => {
    const [east, north] = toMetres(x, y);
    metresPerPixel = Math.min(METRES_PER_PIXEL_MAX, Math.max(METRES_PER_PIXEL_MIN, metresPerPixel / factor));
    centre = [east - (x - width / 2) * metresPerPixel, north + (y - height / 2) * metresPerPixel];
    moved();
  };
  const zoomBy = (factor: number) => zoomAt(factor, width / 2, height / 2);

  const resize = () => {
    width = Math.max(1, container.clientWidth);
    height = Math.max(1, container.clientHeight);
    ratio = Math.min(PIXEL_RATIO_MAX, window.devicePixelRatio || 1);
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    // A canvas of another size is empty at once.
    paint();
    events.moved();
  };

  const pointers = new Map<number, readonly [number, number]>();
  let pressed: readonly [number, number] | null = null;
  const place = (event: PointerEvent | WheelEvent | MouseEvent): readonly [number, number] => {
    const box = canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  canvas.addEventListener("pointerdown", (event) => {
    pointers.set(event.pointerId, place(event));
    pressed = pointers.size === 1 ? place(event) : null;
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    const [x, y] = place(event);
    events.over(toMetres(x, y));
    const from = pointers.get(event.pointerId);
    if (from === undefined) return;
    if (pressed !== null && Math.hypot(x - pressed[0], y - pressed[1]) < PRESS_PX) return;
    pressed = null;
    const other = [...pointers].find(([id]) => id !== event.pointerId)?.[1];
    events.taken();
    if (other === undefined) {
      shift(x - from[0], y - from[1]);
    } else {
      const before = Math.hypot(from[0] - other[0], from[1] - other[1]);
      const after = Math.hypot(x - other[0], y - other[1]);
      if (before > 1 && after > 1) zoomAt(after / before, (x + other[0]) / 2, (y + other[1]) / 2);
    }
    pointers.set(event.pointerId, [x, y]);
  });
  const lift = (event: PointerEvent) => {
    pointers.delete(event.pointerId);
    if (pressed !== null && event.type === "pointerup") events.pressed(toMetres(...pressed));
    pressed = null;
  };
  canvas.addEventListener("pointerup", lift);
  canvas.addEventListener("pointercancel", lift);
  canvas.addEventListener("pointerleave", () => events.over(null));
  canvas.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      events.taken();
      zoomAt(Math.exp(-event.deltaY / 400), ...place(event));
    },
    { passive: false },
  );
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const step: Record<string, () => void> = {
      ArrowLeft: () => shift(KEY_STEP_PX, 0),
      ArrowRight: () => shift(-KEY_STEP_PX, 0),
      ArrowUp: () => shift(0, KEY_STEP_PX),
      ArrowDown: () => shift(0, -KEY_STEP_PX),
      "+": () => zoomBy(2),
      "=": () => zoomBy(2),
      "-": () => zoomBy(0.5),
      // In the middle of the plan: measuring without a mouse.
      Enter: () => events.pressed(centre),
    };
    const action = step[event.key];
    if (action === undefined) return;
    event.preventDefault();
    event.stopPropagation();
    if (event.key !== "Enter") events.taken();
    action();
  });
  const watcher = new ResizeObserver(resize);
  watcher.observe(container);
  // At once: the paper does not wait for a frame.
  printing.addEventListener("change", paint);
  resize();

  return {
    draw(next) {
      shapes = next;
      ask();
    },
    drawGrid(lines) {
      grid = lines;
      ask();
    },
    setUnderlays(nextUnderlays, nextWords) {
      underlays = nextUnderlays;
      words = nextWords;
      ask();
    },
    setPalette(next) {
      colours = next;
      ask();
    },
    setBackdrop(next) {
      backdrop = next;
      ask();
    },
    redraw: ask,
    setMeasuring(measuring) {
      canvas.classList.toggle("measuring", measuring);
    },
    extent: (): Extent => ({ min: toMetres(0, height), max: toMetres(width, 0) }),
    metresPerPixel: () => metresPerPixel,
    toPixels,
    centreOn(point) {
      centre = point;
      moved();
    },
    fit({ min, max }) {
      centre = [(min[0] + max[0]) / 2, (min[1] + max[1]) / 2];
      const across = (max[0] - min[0]) / Math.max(1, width - 2 * EDGE_PX);
      const up = (max[1] - min[1]) / Math.max(1, height - 2 * EDGE_PX);
      metresPerPixel = Math.min(METRES_PER_PIXEL_MAX, Math.max(FIT_METRES_PER_PIXEL_MIN, across, up));
      moved();
    },
    zoomBy,
    destroy() {
      watcher.disconnect();
      printing.removeEventListener("change", paint);
      cancel();
      canvas.remove();
    },
  };
}
