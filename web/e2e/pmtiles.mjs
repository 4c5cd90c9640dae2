/**
 * A small PMTiles file (version 3) of coloured PNG tiles, made here so that every pixel of it is known: blocks of a
 * quarter of a tile, each in one of eight colours by its place. The same each time.
 */

import { crc32, deflateSync, gzipSync } from "node:zlib";

const TILE_PX = 256;
/** Blocks of one colour along a tile's side. */
export const BLOCKS = 4;
const HEADER_BYTES = 127;

/** Far from what the plan itself is drawn in. */
const COLOURS = [
  [255, 0, 0],
  [0, 255, 0],
  [0, 0, 255],
  [255, 255, 0],
  [255, 0, 255],
  [0, 255, 255],
  [128, 0, 0],
  [0, 0, 128],
];

/** Tiles of a zoom, whole and in part, from the world's north-west corner: the textbook's formula. */
export function tileOf(longitude_deg, latitude_deg, zoom) {
  const latitude = (latitude_deg * Math.PI) / 180;
  const side = 2 ** zoom;
  const y = (1 - Math.log(Math.tan(latitude) + 1 / Math.cos(latitude)) / Math.PI) / 2;
  return [((longitude_deg + 180) / 360) * side, y * side];
}

/** The colour of a block, by its column and row in the whole world at that zoom. */
export function colourOf(zoom, column, row) {
  let hash = (Math.imul(column, 73_856_093) ^ Math.imul(row, 19_349_663) ^ Math.imul(zoom, 83_492_791)) >>> 0;
  hash = Math.imul(hash ^ (hash >>> 15), 2_246_822_519) >>> 0;
  return COLOURS[(hash ^ (hash >>> 13)) & 7];
}

/** The tiles of all `zooms` that lie within `reach` tiles of the deepest around a place. */
export function makePmtiles({ longitude_deg, latitude_deg, zooms, reach, metadata }) {
  const deepest = Math.max(...zooms);
  const [x, y] = tileOf(longitude_deg, latitude_deg, deepest);
  const [x0, x1, y0, y1] = [x - reach, x + reach, y - reach, y + reach].map(Math.floor);
  const tiles = zooms.flatMap((z) => {
    const side = 2 ** (deepest - z);
    const found = [];
    for (let row = Math.floor(y0 / side); row <= Math.floor(y1 / side); row += 1) {
      for (let column = Math.floor(x0 / side); column <= Math.floor(x1 / side); column += 1) {
        found.push({ id: tileId(z, column, row), data: png(z, column, row) });
      }
    }
    return found;
  });
  tiles.sort((a, b) => a.id - b.id);
  const directory = gzipSync(directoryOf(tiles));
  const about = gzipSync(JSON.stringify(metadata));
  const data = Buffer.concat(tiles.map((tile) => tile.data));

  const header = Buffer.alloc(HEADER_BYTES);
  header.write("PMTiles", "ascii");
  header[7] = 3;
  let offset = HEADER_BYTES;
  for (const [at, length] of [
    [8, directory.length],
    [24, about.length],
    [40, 0],
    [56, data.length],
  ]) {
    header.writeBigUInt64LE(BigInt(offset), at);
    header.writeBigUInt64LE(BigInt(length), at + 8);
    offset += length;
  }
  for (const at of [72, 80, 88]) header.writeBigUInt64LE(BigInt(tiles.length), at);
  header.set([1, 2, 1, 2, Math.min(...zooms), deepest], 96);
  const [west, south, east, north] = [...cornerOf(x0, y1 + 1, deepest), ...cornerOf(x1 + 1, y0, deepest)];
  [west, south, east, north].forEach((value, index) => {
    header.writeInt32LE(Math.round(value * 1e7), 102 + 4 * index);
  });
  header[118] = deepest;
  header.writeInt32LE(Math.round(longitude_deg * 1e7), 119);
  header.writeInt32LE(Math.round(latitude_deg * 1e7), 123);
  return Buffer.concat([header, directory, about, data]);
}

/** Longitude and latitude of a tile's north-west corner. */
function cornerOf(x, y, zoom) {
  const side = 2 ** zoom;
  const latitude = 2 * Math.atan(Math.exp(Math.PI * (1 - (2 * y) / side))) - Math.PI / 2;
  return [(x / side) * 360 - 180, (latitude * 180) / Math.PI];
}

/** A tile's number: along Hilbert's curve, after all tiles of the zooms before. */
function tileId(zoom, column, row) {
  let id = (4 ** zoom - 1) / 3;
  let [x, y] = [column, row];
  for (let side = 2 ** (zoom - 1); side >= 1; side /= 2) {
    const [right, down] = [(x & side) > 0 ? 1 : 0, (y & side) > 0 ? 1 : 0];
    id += side * side * ((3 * right) ^ down);
    if (down === 0) {
      if (right === 1) [x, y] = [2 ** zoom - 1 - x, 2 ** zoom - 1 - y];
      [x, y] = [y, x];
    }
  }
  return id;
}

/** Numbers as differences, run lengths, lengths, and places, each as a column. */
function directoryOf(tiles) {
  const bytes = [];
  const add = (value) => {
    let left = value;
    while (left >= 128) {
      bytes.push((left % 128) + 128);
      left = Math.floor(left / 128);
    }
    bytes.push(left);
  };
  add(tiles.length);
  tiles.forEach(({ id }, index) => {
    add(id - (tiles[index - 1]?.id ?? 0));
  });
  for (const _ of tiles) add(1);
  for (const { data } of tiles) add(data.length);
  // One tile after the other: the first at nought, which is written as one, the others where the last ended.
  for (const index of tiles.keys()) add(index === 0 ? 1 : 0);
  return Buffer.from(bytes);
}

function png(zoom, column, row) {
  const lines = Buffer.alloc(TILE_PX * (1 + 3 * TILE_PX));
  const block_px = TILE_PX / BLOCKS;
  for (let y = 0; y < TILE_PX; y += 1) {
    for (let x = 0; x < TILE_PX; x += 1) {
      const across = column * BLOCKS + Math.floor(x / block_px);
      const down = row * BLOCKS + Math.floor(y / block_px);
      lines.set(colourOf(zoom, across, down), y * (1 + 3 * TILE_PX) + 1 + 3 * x);
    }
  }
  const size = Buffer.alloc(13);
  size.writeUInt32BE(TILE_PX, 0);
  size.writeUInt32BE(TILE_PX, 4);
  // Eight bits each of red, green and blue.
  size.set([8, 2, 0, 0, 0], 8);
  const signature = Buffer.from([0x89, 0x50, 0x4e, 0x47, 0x0d, 0x0a, 0x1a, 0x0a]);
  const parts = [chunk("IHDR", size), chunk("IDAT", deflateSync(lines)), chunk("IEND", Buffer.alloc(0))];
  return Buffer.concat([signature, ...parts]);
}

function chunk(kind, data) {
  const body = Buffer.concat([Buffer.from(kind, "ascii"), data]);
  const around = Buffer.alloc(4);
  const end = Buffer.alloc(4);
  around.writeUInt32BE(data.length, 0);
  end.writeUInt32BE(crc32(body), 0);
  return Buffer.concat([around, body, end]);
}
