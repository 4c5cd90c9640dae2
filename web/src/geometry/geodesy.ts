/**
 * Between the site's metres (x east, y north) and longitude, latitude, by the same WGS84 formulas as the site.
 *
 * The plan is drawn at the height of the world's origin: 20 m up or down and 500 m away that is 1.6 mm.
 */

import type { WorldOrigin } from "../api/types";

/** Metres in the site's frame: east, north. */
export type Metres = readonly [number, number];
/** Degrees, in the order that GeoJSON and the map want. */
export type LngLat = [number, number];

const SEMI_MAJOR_AXIS_M = 6_378_137.0;
const FLATTENING = 1.0 / 298.257223563;
const ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING);
const DEGREE = Math.PI / 180.0;

type Ecef = [number, number, number];

/** The site's east-north-up frame. */
export class SiteFrame {
  private readonly originEcef: Ecef;
  private readonly sinLat: number;
  private readonly cosLat: number;
  private readonly sinLon: number;
  private readonly cosLon: number;

  constructor(readonly origin: WorldOrigin) {
    this.sinLat = Math.sin(origin.latitude_deg * DEGREE);
    this.cosLat = Math.cos(origin.latitude_deg * DEGREE);
    this.sinLon = Math.sin(origin.longitude_deg * DEGREE);
    this.cosLon = Math.cos(origin.longitude_deg * DEGREE);
    this.originEcef = ecefOf(origin.latitude_deg, origin.longitude_deg, origin.altitude_m);
  }

  /** Where a point of the plan is on Earth. */
  toLngLat([east, north]: Metres): LngLat {
    const [x0, y0, z0] = this.originEcef;
    const x = x0 - this.sinLon * east - this.sinLat * this.cosLon * north;
    const y = y0 + this.cosLon * east - this.sinLat * this.sinLon * north;
    const z = z0 + this.cosLat * north;
    return geodeticOf(x, y, z);
  }

  /** Where a point on Earth, at the height of the origin, is on the plan. */
  toMetres([longitude, latitude]: LngLat): Metres {
    const [x0, y0, z0] = this.originEcef;
    const [x1, y1, z1] = ecefOf(latitude, longitude, this.origin.altitude_m);
    const [x, y, z] = [x1 - x0, y1 - y0, z1 - z0];
    const east = -this.sinLon * x + this.cosLon * y;
    const north = -this.sinLat * (this.cosLon * x + this.sinLon * y) + this.cosLat * z;
    return [east, north];
  }
}

function ecefOf(latitude_deg: number, longitude_deg: number, altitude_m: number): Ecef {
  const sinLat = Math.sin(latitude_deg * DEGREE);
  const normal = SEMI_MAJOR_AXIS_M / Math.sqrt(1.0 - ECCENTRICITY_SQUARED * sinLat * sinLat);
  const horizontal = (normal + altitude_m) * Math.cos(latitude_deg * DEGREE);
  return [
    horizontal * Math.cos(longitude_deg * DEGREE),
    horizontal * Math.sin(longitude_deg * DEGREE),
    (normal * (1.0 - ECCENTRICITY_SQUARED) + altitude_m) * sinLat,
  ];
}

/** Bowring's method, iterated: good to a nanometre near the surface. */
function geodeticOf(x: number, y: number, z: number): LngLat {
  const horizontal = Math.hypot(x, y);
  const semiMinor = SEMI_MAJOR_AXIS_M * (1.0 - FLATTENING);
  const secondEccentricitySquared = ECCENTRICITY_SQUARED / (1.0 - ECCENTRICITY_SQUARED);
  let reducedTan = (z / horizontal) * (SEMI_MAJOR_AXIS_M / semiMinor);
  let latitude = 0.0;
  for (let round = 0; round < 3; round += 1) {
    const reduced = Math.atan(reducedTan);
    latitude = Math.atan2(
      z + secondEccentricitySquared * semiMinor * Math.sin(reduced) ** 3,
      horizontal - ECCENTRICITY_SQUARED * SEMI_MAJOR_AXIS_M * Math.cos(reduced) ** 3,
    );
    reducedTan = (1.0 - FLATTENING) * Math.tan(latitude);
  }
  return [Math.atan2(y, x) / DEGREE, latitude / DEGREE];
}
