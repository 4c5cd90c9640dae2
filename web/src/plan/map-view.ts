/**
 * The plan on MapLibre GL, without any tiles: a ground colour, the grid, and one source for all machines.
 *
 * Sources go down to zoom 24, where the grid that MapLibre snaps to is a third of a millimetre; at its default
 * of 18 it would be two centimetres. New shapes wait until the map has taken the ones before.
 */

import { type GeoJSONSource, Map as GlMap, type LayerSpecification, setWorkerUrl } from "maplibre-gl";
import workerUrl from "maplibre-gl/dist/maplibre-gl-worker.mjs?url";

import type { Metres, SiteFrame } from "../geometry/geodesy";
import type { Extent, GridLine } from "../geometry/grid";
import type { Palette } from "./palette";
import { LAYERS, type PlanEvents, type PlanView, type Shape } from "./view";

const SOURCE_MAX_ZOOM = 24;
const ZOOM_MIN = 10;
const ZOOM_MAX = 25;
/** Fitting two machines side by side goes no closer than this. */
const FIT_ZOOM_MAX = 22.2;
const EDGE_PX = 56;

export function createMapView(
  container: HTMLElement,
  frame: SiteFrame,
  palette: Palette,
  label: string,
  events: PlanEvents,
): PlanView {
  setWorkerUrl(new URL(workerUrl, window.location.href).href);
  const map = new GlMap({
    container,
    style: { version: 8, sources: {}, layers: [ground(palette)] },
    center: frame.toLngLat([0, 0]),
    zoom: 19,
    minZoom: ZOOM_MIN,
    maxZoom: ZOOM_MAX,
    dragRotate: false,
    pitchWithRotate: false,
    touchPitch: false,
    renderWorldCopies: false,
    attributionControl: false,
    fadeDuration: 0,
    locale: { "Map.Title": label },
  });
  map.touchZoomRotate.disableRotation();
  map.keyboard.disableRotation();

  const machines = new Feed(map, "machines");
  const grid = new Feed(map, "grid");
  map.on("load", () => {
    for (const source of ["grid", "machines"]) {
      map.addSource(source, {
        type: "geojson",
        data: collection([]),
        maxzoom: SOURCE_MAX_ZOOM,
        tolerance: 0,
      });
    }
    for (const layer of [gridLayer(), ...LAYERS.flatMap(shapeLayers)]) map.addLayer(layer);
    grid.open();
    machines.open();
  });
  map.on("move", () => events.moved());
  map.on("resize", () => events.moved());
  // Only moves that began with a person's hand carry the event of the hand.
  map.on("movestart", (event) => {
    if (event.originalEvent !== undefined) events.taken();
  });
  map.on("webglcontextlost", () => events.failed("the graphics context was lost"));

  let colours = palette;
  let gridLines: readonly GridLine[] = [];
  const toPixels = (point: Metres): readonly [number, number] => {
    const { x, y } = map.project(frame.toLngLat(point));
    return [x, y];
  };
  const drawGrid = () => grid.give(gridLines.map((line) => gridFeature(line, colours, frame)));

  return {
    draw: (shapes) => machines.give(shapes.flatMap((shape) => shapeFeatures(shape, frame))),
    drawGrid(lines) {
      gridLines = lines;
      drawGrid();
    },
    setPalette(next) {
      colours = next;
      if (map.getLayer("ground") !== undefined)
        map.setPaintProperty("ground", "background-color", next.ground);
      drawGrid();
    },
    extent(): Extent {
      const bounds = map.getBounds();
      return {
        min: frame.toMetres(bounds.getSouthWest().toArray()),
        max: frame.toMetres(bounds.getNorthEast().toArray()),
      };
    },
    metresPerPixel() {
      const { clientWidth: width, clientHeight: height } = map.getCanvas();
      const left = frame.toMetres(map.unproject([0, height / 2]).toArray());
      const right = frame.toMetres(map.unproject([width, height / 2]).toArray());
      return Math.hypot(right[0] - left[0], right[1] - left[1]) / Math.max(1, width);
    },
    toPixels,
    centreOn: (point) => void map.jumpTo({ center: frame.toLngLat(point) }),
    fit: ({ min, max }) =>
      void map.fitBounds([frame.toLngLat(min), frame.toLngLat(max)], {
        padding: EDGE_PX,
        maxZoom: FIT_ZOOM_MAX,
        animate: false,
      }),
    zoomBy: (factor) => void map.easeTo({ zoom: map.getZoom() + Math.log2(factor), duration: 150 }),
    destroy: () => map.remove(),
  };
}

/** Hands data to a source one at a time: the newest waits until the map has taken the one before. */
class Feed {
  private waiting: GeoJSON.Feature[] | null = null;
  private busy = true;

  constructor(
    private readonly map: GlMap,
    private readonly name: string,
  ) {}

  /** The source is there. */
  open(): void {
    this.busy = false;
    this.next();
  }

  give(features: GeoJSON.Feature[]): void {
    this.waiting = features;
    this.next();
  }

  private next(): void {
    const source = this.map.getSource<GeoJSONSource>(this.name);
    if (this.busy || this.waiting === null || source === undefined) return;
    const features = this.waiting;
    this.waiting = null;
    this.busy = true;
    const done = () => {
      this.busy = false;
      this.next();
    };
    source.setData(collection(features)).then(done, done);
  }
}

function collection(features: GeoJSON.Feature[]): GeoJSON.FeatureCollection {
  return { type: "FeatureCollection", features };
}

function gridFeature(line: GridLine, palette: Palette, frame: SiteFrame): GeoJSON.Feature {
  return {
    type: "Feature",
    properties: { stroke: line.major ? palette.gridMajor : palette.gridMinor },
    geometry: { type: "LineString", coordinates: [frame.toLngLat(line.from), frame.toLngLat(line.to)] },
  };
}

/** An area becomes its filled polygon and its outline, so that one line layer draws every stroke. */
function shapeFeatures(shape: Shape, frame: SiteFrame): GeoJSON.Feature[] {
  const coordinates = shape.points.map((point) => frame.toLngLat(point));
  const features: GeoJSON.Feature[] = [];
  if (shape.kind === "area" && shape.fill !== undefined) {
    const properties = { layer: shape.layer, fill: shape.fill, opacity: shape.fillOpacity ?? 1 };
    features.push({ type: "Feature", properties, geometry: { type: "Polygon", coordinates: [coordinates] } });
  }
  if (shape.stroke !== undefined) {
    const properties = {
      layer: shape.layer,
      stroke: shape.stroke,
      opacity: shape.strokeOpacity ?? 1,
      width: shape.strokeWidth_px ?? 1,
    };
    features.push({ type: "Feature", properties, geometry: { type: "LineString", coordinates } });
  }
  return features;
}

function ground(palette: Palette): LayerSpecification {
  return { id: "ground", type: "background", paint: { "background-color": palette.ground } };
}

function gridLayer(): LayerSpecification {
  return {
    id: "grid",
    type: "line",
    source: "grid",
    paint: { "line-color": ["get", "stroke"], "line-width": 1 },
  };
}

function shapeLayers(layer: string): LayerSpecification[] {
  return [
    {
      id: `${layer}-area`,
      type: "fill",
      source: "machines",
      filter: ["all", ["==", ["get", "layer"], layer], ["has", "fill"]],
      paint: { "fill-color": ["get", "fill"], "fill-opacity": ["get", "opacity"], "fill-antialias": false },
    },
    {
      id: `${layer}-line`,
      type: "line",
      source: "machines",
      filter: ["all", ["==", ["get", "layer"], layer], ["has", "stroke"]],
      layout: { "line-join": "round", "line-cap": "round" },
      paint: {
        "line-color": ["get", "stroke"],
        "line-opacity": ["get", "opacity"],
        "line-width": ["get", "width"],
      },
    },
  ];
}
