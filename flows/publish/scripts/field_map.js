"use strict";
// The map of a report: pictures as layers in Leaflet, whose own control switches them.
const facts = JSON.parse(document.getElementById("field-data").textContent);
const [width, height] = facts.size, whole = [[-height, 0], [0, width]], layers = {};
globalThis.map = L.map("map", { crs: L.CRS.Simple, attributionControl: false, zoomSnap: 0.25, minZoom: -6, maxZoom: 6 });
for (const { title, picture, shown, opacity } of facts.layers) {
  layers[title] = L.imageOverlay(picture, whole, { opacity, alt: title });
  if (shown) layers[title].addTo(map);
}
L.control.layers(null, layers).addTo(map);
map.fitBounds(whole, { animate: false });
map.setMaxBounds(map.getBounds().pad(0.5));
document.getElementById("field").dataset.ready = "yes";
