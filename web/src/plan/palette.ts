/** The plan's colours, for light and for dark. Colour never speaks alone: words and shapes say the same. */

import type { GnssState } from "../api/types";

export interface Palette {
  ground: string;
  /** How much of the basemap is seen over the ground. */
  backdropOpacity: number;
  gridMinor: string;
  gridMajor: string;
  chassis: string;
  track: string;
  outline: string;
  cabin: string;
  glass: string;
  boom: string;
  ellipse: string;
  selection: string;
  hatch: string;
  /** Lines and words of the site's plan. */
  planInk: string;
  planArea: string;
  measure: string;
  shadow: string;
  gnss: Record<GnssState | "float" | "link_lost" | "unknown", string>;
}

export const LIGHT: Palette = {
  ground: "#eef1f0",
  backdropOpacity: 1,
  gridMinor: "#dde2e1",
  gridMajor: "#c3ccca",
  chassis: "#7b868a",
  track: "#4a5356",
  outline: "#23292b",
  cabin: "#f0b429",
  glass: "#cfe3ea",
  boom: "#e09d12",
  ellipse: "#0f6fb8",
  selection: "#0b4f86",
  hatch: "#23292b",
  planInk: "#56666b",
  planArea: "#8fa3a8",
  measure: "#7d2fb8",
  shadow: "#c23b22",
  gnss: {
    fixed: "#138a63",
    recovering: "#2470d8",
    degraded: "#c77700",
    jumping: "#b3267e",
    frozen: "#7d3fc0",
    silent: "#c23b22",
    float: "#a87900",
    link_lost: "#5b666a",
    unknown: "#7c8789",
  },
};

export const DARK: Palette = {
  ground: "#14191b",
  backdropOpacity: 0.5,
  gridMinor: "#1d2427",
  gridMajor: "#2a3438",
  chassis: "#69757a",
  track: "#8d999e",
  outline: "#0a0d0e",
  cabin: "#e8ac24",
  glass: "#a9c8d4",
  boom: "#cd8f14",
  ellipse: "#62b2f2",
  selection: "#9fd4ff",
  hatch: "#0a0d0e",
  planInk: "#93a3a8",
  planArea: "#5b6b70",
  measure: "#d59bff",
  shadow: "#ff7a5f",
  gnss: {
    fixed: "#35c693",
    recovering: "#6ea8ff",
    degraded: "#f2a83b",
    jumping: "#f06bbd",
    frozen: "#b88af0",
    silent: "#ff7a5f",
    float: "#e0c04a",
    link_lost: "#a3afb2",
    unknown: "#8f9b9e",
  },
};
