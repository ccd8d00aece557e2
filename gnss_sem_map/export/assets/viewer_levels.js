"use strict";
// The nodes of the map: squares of 512 x 512 columns of voxels, coarse ones in this page, finer ones in files beside
// it. A file is loaded as a script, which a browser allows from file:// too, and calls `voxels`.
// Lengths are in voxels of the map; level k has voxels of 2^k.

const COLUMNS = 512, STRIDE = 12;   // bytes of a voxel on the graphics card: three int16, two unused, about, one unused
const FINE_PIXELS = 1.5;            // larger on the screen, voxels are replaced by finer ones
const AT_ONCE = 4;                  // files that are loaded at the same time
let most = 4e6;                     // voxels of finer levels in memory

function nodeOf([level, x, y, low, high, ...quadrants]) {
  const scale = 2 ** level;
  const corner = [x * COLUMNS * scale, y * COLUMNS * scale, low * scale];
  return { name: `${level}_${x}_${y}`, level, x, y, scale, corner, quadrants, children: [], parent: null,
           opposite: [corner[0] + COLUMNS * scale, corner[1] + COLUMNS * scale, (high + 1) * scale],
           count: quadrants.reduce((a, b) => a + b), state: "absent", lastUsed: 0 };
}

// All nodes by name, each with its finer ones in the order of its quadrants.
function nodesOf(listed) {
  const nodes = new Map(listed.map(nodeOf).map(node => [node.name, node]));
  for (const node of nodes.values()) {
    const parent = nodes.get(`${node.level + 1}_${node.x >> 1}_${node.y >> 1}`);
    if (!parent) continue;
    parent.children[(node.x & 1) | (node.y & 1) << 1] = node;
    node.parent = parent;
  }
  return nodes;
}

async function inflated(text) {
  const packed = Uint8Array.from(atob(text), c => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Planes of n bytes: for x, y and z the low and the high byte of the zigzag difference to the voxel before, then class,
// confidence and origin.
function decoded(bytes, n) {
  const data = new ArrayBuffer(STRIDE * n), cells = new Int16Array(data), about = new Uint8Array(data);
  let at = 0;
  const plane = () => bytes.subarray(at, at += n);
  for (let axis = 0; axis < 3; axis++) {
    const low = plane(), high = plane();
    for (let i = 0, value = 0; i < n; i++) {
      const zigzag = low[i] | high[i] << 8;
      cells[STRIDE / 2 * i + axis] = value += (zigzag >>> 1) ^ -(zigzag & 1);
    }
  }
  for (let k = 0; k < 3; k++) {
    const values = plane();
    for (let i = 0; i < n; i++) about[STRIDE * i + 8 + k] = values[i];
  }
  return data;
}

// Corners and distances relative to the camera; nothing is said of boxes behind it or beside its view.
function seen({ corner, opposite }, { eye, axes, tangents }) {
  const radius = Math.hypot(...opposite.map((v, k) => v - corner[k])) / 2;
  const [right, up, ahead] = axes.map(axis => axis.reduce(
    (sum, a, k) => sum + a * ((corner[k] + opposite[k]) / 2 - eye[k]), 0));
  return ahead > -radius
    && Math.abs(right) < ahead * tangents[0] + radius * Math.hypot(1, tangents[0])
    && Math.abs(up) < ahead * tangents[1] + radius * Math.hypot(1, tangents[1]);
}

function distanceTo({ corner, opposite }, eye) {
  return Math.max(1, Math.hypot(...eye.map((e, k) => Math.max(corner[k] - e, 0, e - opposite[k]))));
}

// The finer nodes that this view needs, the most urgent first, as many as `most` allows. A node is needed where the
// voxels of its parent are large on the screen, so a parent comes before its children.
function needed(roots, view) {
  const found = [];
  const visit = node => node.children.forEach(child => {
    const pixels = node.scale * view.focal / distanceTo(child, view.eye);
    if (pixels < FINE_PIXELS || !seen(child, view)) return;
    found.push({ child, pixels });
    visit(child);
  });
  roots.forEach(visit);
  found.sort((a, b) => b.pixels - a.pixels);
  let sum = 0;
  const last = found.findIndex(({ child }) => (sum += child.count) > most);
  return found.slice(0, last < 0 ? found.length : last).map(({ child }) => child);
}

// What is drawn: [node, first voxel, voxels]. A quadrant is left to its finer node if that is needed and there.
function ranges(roots, wanted, view) {
  const drawn = [], chosen = new Set(wanted);
  const visit = node => {
    const finer = [];
    let first = 0;
    node.quadrants.forEach((count, q) => {
      const child = node.children[q];
      if (child?.state === "ready" && chosen.has(child)) finer.push(child);
      else if (count && seen(node, view)) drawn.push([node, first, count]);
      first += count;
    });
    finer.forEach(visit);
  };
  roots.forEach(visit);
  return drawn;
}
