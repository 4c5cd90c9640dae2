/** The site's own plan and the map of its GNSS shadows, from GeoJSON to paths in metres. */

import { MessageError, record } from "../api/checking";
import { ApiError, ask } from "../api/http";
import type { ShadowCell } from "../api/shadow-map";
import type { LngLat, Metres, SiteFrame } from "../geometry/geodesy";
import type { Palette } from "./palette";
import type { PlanWord, Underlay } from "./view";

export interface PlanFeature {
  kind: "point" | "line" | "area";
  /** One ring or line each. */
  lines: Metres[][];
  name: string | null;
  stroke: string | null;
  fill: string | null;
}

const PLAN = "/api/v1/plan";
const POINT_RADIUS_M = 0.35;
/** A cell in which machines were shorter than this says nothing. */
const SHADOW_LEAST_S = 5;

/** The site's plan; empty where the site has none. */
export async function fetchPlan(frame: SiteFrame): Promise<PlanFeature[]> {
  try {
    const response = await ask(PLAN, { headers: { accept: "application/geo+json" } });
    return readPlan(await response.json(), frame);
  } catch (error) {
    if (error instanceof ApiError && error.status === 404) return [];
    throw error;
  }
}

export async function putPlan(file: Blob): Promise<void> {
  await ask(PLAN, {
    method: "PUT",
    body: await file.text(),
    headers: { "content-type": "application/geo+json" },
  });
}

/** Features of a GeoJSON collection (RFC 7946); those of a kind that is not drawn are passed over. */
export function readPlan(value: unknown, frame: SiteFrame): PlanFeature[] {
  const collection = record(value, "plan");
  return items(collection.features, "plan.features").flatMap((feature) => {
    const { geometry, properties } = record(feature, "feature");
    if (geometry === null || geometry === undefined) return [];
    const looks = (properties ?? {}) as Record<string, unknown>;
    const common = {
      name: typeof looks.name === "string" ? looks.name.slice(0, 60) : null,
      stroke: colourOf(looks.stroke),
      fill: colourOf(looks.fill),
    };
    return partsOf(record(geometry, "geometry"), frame).map((part) => ({ ...part, ...common }));
  });
}

type Part = Pick<PlanFeature, "kind" | "lines">;

function partsOf(geometry: Record<string, unknown>, frame: SiteFrame): Part[] {
  const at = (point: unknown) => placeOf(point, frame);
  const line = (points: unknown) => items(points).map(at);
  const rings = (polygon: unknown) => items(polygon).map(line);
  const { type, coordinates } = geometry;
  switch (type) {
    case "Point":
      return [{ kind: "point", lines: [[at(coordinates)]] }];
    case "MultiPoint":
      return items(coordinates).map((point): Part => ({ kind: "point", lines: [[at(point)]] }));
    case "LineString":
      return [{ kind: "line", lines: [line(coordinates)] }];
    case "MultiLineString":
      return [{ kind: "line", lines: rings(coordinates) }];
    case "Polygon":
      return [{ kind: "area", lines: rings(coordinates) }];
    case "MultiPolygon":
      return items(coordinates).map((polygon): Part => ({ kind: "area", lines: rings(polygon) }));
    case "GeometryCollection":
      return items(geometry.geometries).flatMap((inner) => partsOf(record(inner, "geometry"), frame));
    default:
      return [];
  }
}

function items(value: unknown, path = "coordinates"): unknown[] {
  if (!Array.isArray(value)) throw new MessageError(path, "a list", value);
  return value;
}

function placeOf(value: unknown, frame: SiteFrame): Metres {
  const [longitude, latitude] = items(value);
  if (typeof longitude !== "number" || typeof latitude !== "number") {
    throw new MessageError("coordinates", "longitude and latitude", value);
  }
  return frame.toMetres([longitude, latitude] satisfies LngLat);
}

/** Only plain colours: what is in the plan comes from a file. */
function colourOf(value: unknown): string | null {
  return typeof value === "string" && /^#([0-9a-f]{3}|[0-9a-f]{6})$/i.test(value) ? value : null;
}

export function planUnderlays(
  features: readonly PlanFeature[],
  palette: Palette,
): { underlays: Underlay[]; words: PlanWord[] } {
  const words: PlanWord[] = [];
  const order = { area: 0, line: 1, point: 2 };
  const inOrder = [...features].sort((a, b) => order[a.kind] - order[b.kind]);
  const underlays = inOrder.map((feature): Underlay => {
    const path = new Path2D();
    for (const points of feature.lines) {
      points.forEach(([east, north], index) => {
        if (feature.kind === "point") path.arc(east, north, POINT_RADIUS_M, 0, 2 * Math.PI);
        else if (index === 0) path.moveTo(east, north);
        else path.lineTo(east, north);
      });
      if (feature.kind === "area") path.closePath();
    }
    const first = feature.lines[0] ?? [];
    if (feature.name !== null && first.length > 0) words.push({ at: middle(first), text: feature.name });
    const stroke = { stroke: feature.stroke ?? palette.planInk, strokeWidth_px: 1.5 };
    if (feature.kind === "line") return { path, ...stroke };
    return { path, fill: feature.fill ?? palette.planArea, fillOpacity: 0.22, ...stroke };
  });
  return { underlays, words };
}

function middle(points: readonly Metres[]): Metres {
  const sum = points.reduce<Metres>((total, point) => [total[0] + point[0], total[1] + point[1]], [0, 0]);
  return [sum[0] / points.length, sum[1] / points.length];
}

/** Five shades by the share of the time without good GNSS; cells that were always good stay bare. */
export function shadowUnderlays(cells: readonly ShadowCell[], palette: Palette): Underlay[] {
  const shades = [0.1, 0.25, 0.5, 0.75, 1.01];
  const paths = shades.map(() => new Path2D());
  for (const cell of cells) {
    if (cell.observed_s < SHADOW_LEAST_S || cell.share_without_gnss < 0.01) continue;
    const shade = shades.findIndex((limit) => cell.share_without_gnss < limit);
    paths[shade]?.rect(cell.east_m, cell.north_m, cell.cell_m, cell.cell_m);
  }
  return paths.map((path, index) => ({ path, fill: palette.shadow, fillOpacity: 0.1 + 0.12 * index }));
}
