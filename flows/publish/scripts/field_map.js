"use strict";
// The map of a report: pictures as layers in Leaflet, whose own control switches them; a slider fades all but the lowest.
const facts = JSON.parse(document.getElementById("field-data").textContent);
const [width, height] = facts.size, pixel = facts.pixel_m, whole = [[-height, 0], [0, width]], layers = {};
globalThis.map = L.map("map", { crs: L.CRS.Simple, attributionControl: false, zoomSnap: 0, minZoom: -6, maxZoom: 6 });
for (const [zIndex, { title, picture, shown, opacity }] of facts.layers.entries()) {
  layers[title] = L.imageOverlay(picture, whole, { opacity, zIndex, alt: title });
  if (shown) layers[title].addTo(map);
}
L.control.layers(null, layers).addTo(map);
map.fitBounds(whole, { animate: false });
document.getElementById("opacity").addEventListener("input", (event) => {
  for (const { title, opacity } of facts.layers.slice(1)) layers[title].setOpacity(opacity * event.target.value / 100);
});
// A scale bar of at most 150 px of the screen: the largest 1, 2 or 5 times a power of ten, in m or in px of the field.
const scale = L.control({ position: "bottomleft" }), bar = L.DomUtil.create("div", "scale");
scale.onAdd = () => bar;
function measure() {
  const zoom = map.getZoomScale(map.getZoom(), 0), side = pixel ?? 1, most = 150 / zoom * side;
  const power = 10 ** Math.floor(Math.log10(most)), length = power * [5, 2, 1].find((times) => times * power <= most);
  bar.style.width = `${length / side * zoom}px`;
  const [size, unit] = pixel === null ? [1, "px"] : length >= 1000 ? [1000, "km"] : length < 1 ? [0.01, "cm"] : [1, "m"];
  bar.textContent = `${Number((length / size).toPrecision(3))} ${unit}`;
}
map.on("zoomend", measure).addControl(scale);
measure();
map.setMaxBounds(map.getBounds().pad(0.5));
document.getElementById("field").dataset.ready = "yes";
