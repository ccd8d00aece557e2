"use strict";
// The view in the address, so that it can be sent to somebody: #at=EAST,NORTH,UP,DISTANCE,AZIMUTH,ELEVATION (metres of
// the map, degrees) &colour=height &hide=building,vegetation &least=0.5 (confidence) &removed. Each part may be left
// out.

const WRITE_AFTER_MS = 300;  // browsers refuse an address that changes with every frame
let writing = 0;

function linkSoon() {
  clearTimeout(writing);
  writing = setTimeout(() => history.replaceState(null, "", link()), WRITE_AFTER_MS);
}

function link() {
  const lengths = [...metresAt(camera.target), camera.distance * meta.voxel_m].map(metres => metres.toFixed(2));
  const angles = [camera.azimuth, camera.elevation].map(radians => (radians * 180 / Math.PI).toFixed(2));
  const hidden = layers.filter((_, i) => !visible[i]).map(({ name }) => encodeURIComponent(name));
  return `#at=${[...lengths, ...angles]}&colour=${document.querySelector("select").value}&hide=${hidden}`
    + (leastConfidence ? `&least=${leastConfidence}` : "") + (showRemoved ? "&removed" : "");
}

function followLink() {
  const parts = new URLSearchParams(location.hash.slice(1));
  const hidden = (parts.get("hide") ?? (meta.classes.some(({ count }) => count) ? "unlabelled" : "")).split(",");
  layers.forEach(({ name }, i) => { visible[i] = !hidden.includes(name); });
  showRemoved = parts.has("removed");
  cutAt(Number(parts.get("least")));
  const numbers = (parts.get("at") ?? "").split(",").map(Number);
  if (numbers.length === 6 && numbers.every(Number.isFinite)) {
    const [distance, azimuth, elevation] = numbers.slice(3);
    camera.target = numbers.slice(0, 3).map((metres, k) => metres / meta.voxel_m - meta.origin[k]);
    camera.azimuth = azimuth * Math.PI / 180;
    camera.elevation = clampedElevation(elevation * Math.PI / 180);
    camera.distance = clampedDistance(distance / meta.voxel_m);
  }
  colourBy(parts.get("colour") ?? "class");
}

addEventListener("hashchange", () => {
  followLink();
  redraw();
});
