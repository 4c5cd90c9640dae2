/** The plain plan: the same shapes as SVG, for browsers without WebGL. Drag, wheel and keys move it. */

import type { Metres } from "../geometry/geodesy";
import type { Extent, GridLine } from "../geometry/grid";
import type { Palette } from "./palette";
import { LAYERS, type PlanEvents, type PlanView, type Shape } from "./view";

const SVG = "http://www.w3.org/2000/svg";
const METRES_PER_PIXEL_MIN = 0.0015;
const METRES_PER_PIXEL_MAX = 60;
/** Fitting two machines side by side goes no closer than this. */
const FIT_METRES_PER_PIXEL_MIN = 0.011;
const EDGE_PX = 56;
/** An arrow key moves the plan by this. */
const KEY_STEP_PX = 80;

export function createSvgView(
  container: HTMLElement,
  palette: Palette,
  label: string,
  events: PlanEvents,
): PlanView {
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("class", "plan-svg");
  svg.setAttribute("tabindex", "0");
  svg.setAttribute("role", "application");
  svg.setAttribute("aria-label", label);
  const ground = svg.appendChild(element("rect", { width: "100%", height: "100%", fill: palette.ground }));
  const gridGroup = svg.appendChild(element("g", {}));
  const shapeGroup = svg.appendChild(element("g", {}));
  container.append(svg);

  let centre: Metres = [0, 0];
  let metresPerPixel = 0.1;
  let colours = palette;
  let shapes: readonly Shape[] = [];
  let grid: readonly GridLine[] = [];

  const size = (): readonly [number, number] => [container.clientWidth, container.clientHeight];
  const toPixels = ([east, north]: Metres): readonly [number, number] => {
    const [width, height] = size();
    return [
      width / 2 + (east - centre[0]) / metresPerPixel,
      height / 2 - (north - centre[1]) / metresPerPixel,
    ];
  };
  const pathOf = (points: readonly Metres[]) =>
    `M${points.map((point) => toPixels(point).map((pixel) => pixel.toFixed(2))).join("L")}`;

  const paintGrid = () =>
    gridGroup.replaceChildren(
      ...grid.map((line) =>
        element("path", {
          d: pathOf([line.from, line.to]),
          stroke: line.major ? colours.gridMajor : colours.gridMinor,
          fill: "none",
        }),
      ),
    );
  const paintShapes = () => {
    const inOrder = [...shapes].sort((a, b) => LAYERS.indexOf(a.layer) - LAYERS.indexOf(b.layer));
    shapeGroup.replaceChildren(
      ...inOrder.map((shape) =>
        element("path", {
          d: pathOf(shape.points),
          fill: shape.fill ?? "none",
          "fill-opacity": String(shape.fillOpacity ?? 1),
          stroke: shape.stroke ?? "none",
          "stroke-opacity": String(shape.strokeOpacity ?? 1),
          "stroke-width": String(shape.strokeWidth_px ?? 1),
          "stroke-linejoin": "round",
          "data-layer": shape.layer,
        }),
      ),
    );
  };
  const moved = () => {
    paintGrid();
    paintShapes();
    events.moved();
  };
  const shift = (right_px: number, down_px: number) => {
    centre = [centre[0] - right_px * metresPerPixel, centre[1] + down_px * metresPerPixel];
    moved();
  };
  const zoomBy = (factor: number) => {
    metresPerPixel = Math.min(METRES_PER_PIXEL_MAX, Math.max(METRES_PER_PIXEL_MIN, metresPerPixel / factor));
    moved();
  };

  let dragFrom: readonly [number, number] | null = null;
  svg.addEventListener("pointerdown", (event) => {
    dragFrom = [event.clientX, event.clientY];
    svg.setPointerCapture(event.pointerId);
  });
  svg.addEventListener("pointermove", (event) => {
    if (dragFrom === null) return;
    events.taken();
    shift(event.clientX - dragFrom[0], event.clientY - dragFrom[1]);
    dragFrom = [event.clientX, event.clientY];
  });
  svg.addEventListener("pointerup", () => {
    dragFrom = null;
  });
  svg.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      events.taken();
      zoomBy(Math.exp(-event.deltaY / 400));
    },
    { passive: false },
  );
  svg.addEventListener("keydown", (event) => {
    const step: Record<string, () => void> = {
      ArrowLeft: () => shift(KEY_STEP_PX, 0),
      ArrowRight: () => shift(-KEY_STEP_PX, 0),
      ArrowUp: () => shift(0, KEY_STEP_PX),
      ArrowDown: () => shift(0, -KEY_STEP_PX),
      "+": () => zoomBy(2),
      "=": () => zoomBy(2),
      "-": () => zoomBy(0.5),
    };
    const action = step[event.key];
    if (action === undefined) return;
    event.preventDefault();
    events.taken();
    action();
  });
  const watcher = new ResizeObserver(moved);
  watcher.observe(container);

  return {
    draw(next) {
      shapes = next;
      paintShapes();
    },
    drawGrid(lines) {
      grid = lines;
      paintGrid();
    },
    setPalette(next) {
      colours = next;
      ground.setAttribute("fill", next.ground);
      paintGrid();
    },
    extent(): Extent {
      const [width, height] = size();
      const half: Metres = [(width / 2) * metresPerPixel, (height / 2) * metresPerPixel];
      return {
        min: [centre[0] - half[0], centre[1] - half[1]],
        max: [centre[0] + half[0], centre[1] + half[1]],
      };
    },
    metresPerPixel: () => metresPerPixel,
    toPixels,
    centreOn(point) {
      centre = point;
      moved();
    },
    fit({ min, max }) {
      const [width, height] = size();
      centre = [(min[0] + max[0]) / 2, (min[1] + max[1]) / 2];
      const across = (max[0] - min[0]) / Math.max(1, width - 2 * EDGE_PX);
      const up = (max[1] - min[1]) / Math.max(1, height - 2 * EDGE_PX);
      metresPerPixel = Math.min(METRES_PER_PIXEL_MAX, Math.max(FIT_METRES_PER_PIXEL_MIN, across, up));
      moved();
    },
    zoomBy,
    destroy() {
      watcher.disconnect();
      svg.remove();
    },
  };
}

function element(name: string, attributes: Record<string, string>): SVGElement {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}
