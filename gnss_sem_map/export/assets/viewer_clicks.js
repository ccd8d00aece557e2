"use strict";
// What a click tells: what is there, where that is, and how far it is from the click before.

const POST = 1;        // metres that a measured point stands out of the ground
let corners = null;    // where somebody clicked who measures, in voxels; null when nobody does

// What the picture shows at a pointer: the node, the number in it, the place, class, confidence and origin; null for the
// sky.
function voxelAt(event) {
  const scale = canvas.width / innerWidth, found = new Uint32Array(4);
  gl.bindFramebuffer(gl.READ_FRAMEBUFFER, target.buffer);
  gl.readBuffer(gl.COLOR_ATTACHMENT1);
  gl.readPixels(event.clientX * scale, canvas.height - 1 - event.clientY * scale, 1, 1,
                gl.RGBA_INTEGER, gl.UNSIGNED_INT, found);
  if (!found[0]) return null;
  const number = found[0] - 1;
  const [node] = scene.drawn.find(([{ before, count }]) => number >= before && number < before + count);
  const stride = node.texts ? 16 : STRIDE, bytes = new Uint8Array(stride);
  gl.bindBuffer(gl.ARRAY_BUFFER, node.buffer);
  gl.getBufferSubData(gl.ARRAY_BUFFER, stride * (number - node.before), bytes);
  const cell = node.texts ? new Float32Array(bytes.buffer, 0, 3) : new Int16Array(bytes.buffer, 0, 3);
  const place = [...cell].map((v, k) => (v + 0.5) * node.scale + node.corner[k]);
  return [node, number - node.before, place, ...bytes.subarray(stride - 4)];
}

function pick(event) {
  const found = voxelAt(event);
  if (corners && found && found[0] !== scene.measured) {  // the second of two clicks meets the post of the first
    corners.push(found[2]);
    drawMeasured();
  }
  document.getElementById("picked").textContent =
    found ? [...(corners ? distances() : []), ...described(...found)].join("\n") : "";
}

function goTo(event) {
  const found = voxelAt(event);
  if (!found) return;
  camera.target = found[2];
  zoom(1 / 3);
}

const metresAt = place => place.map((v, k) => (v + meta.origin[k]) * meta.voxel_m);
const written = metres => metres.toFixed(meta.voxel_m < 0.1 ? 2 : 1);

function described(node, number, place, label, confidence, origin) {
  const metres = metresAt(place), [east, north, up] = metres.map(written);
  const what = node.texts ? node.texts[number] : `${layers[label]?.name}, ${ORIGINS[origin]}`
    + (label < classes ? `, probability ${(confidence / 255).toFixed(2)}` : "")
    + (node.level ? `, the most hit voxel in ${inMetres(node.scale)} m` : "");
  return [what, ...delivered(metres), `map: east ${east} m, north ${north} m, up ${up} m`];
}

// Easting, northing, height, latitude and longitude are polynomials of the place in the map, see `placing.py`; that of
// longitude goes on beyond 180 degrees.
function delivered(metres) {
  if (!meta.placing) return [];
  const { centre, half, powers, coefficients, crs, heights } = meta.placing;
  const at = metres.map((m, k) => (m - centre[k]) / half[k]);
  const terms = powers.map(power => power.reduce((product, p, k) => product * at[k] ** p, 1));
  const [easting, northing, height, lat, lon] = coefficients.map(row => row.reduce((sum, c, i) => sum + c * terms[i], 0));
  return [`${crs}: ${written(easting)} E, ${written(northing)} N`,
          `height ${written(height)} m ${heights}`, `WGS 84: ${lat.toFixed(6)}°, ${(lon - 360 * Math.round(lon / 360)).toFixed(6)}°`];
}

function measure(on) {
  corners = on ? [] : null;
  document.getElementById("picked").textContent = on ? "click on two points or more" : "";
  drawMeasured();
}

// Of the last two corners, and along all of them.
function distances() {
  const metres = corners.map(metresAt);
  const sides = metres.slice(1).map((end, i) => end.map((m, k) => m - metres[i][k]));
  if (!sides.length) return ["distance: click on the next point"];
  const [east, north, up] = sides.at(-1), sum = sides.reduce((total, side) => total + Math.hypot(...side), 0);
  return [`distance ${written(Math.hypot(east, north, up))} m`
    + ` (horizontal ${written(Math.hypot(east, north))} m, up ${written(up)} m)`,
    ...(sides.length > 1 ? [`${sides.length} parts: ${written(sum)} m`] : [])];
}

function drawMeasured() {
  if (scene.measured) drop(scene.measured);
  const posts = (corners ?? []).map(([x, y, z]) => [[x, y, z], [x, y, z + POST / meta.voxel_m]]);
  const lines = (corners?.length ? [corners, ...posts] : []).map(points => ({ points, text: "measured", layer: layers.length - 1 }));
  scene.measured = lines.length ? beadNode(lines) : null;
  redraw();
}
