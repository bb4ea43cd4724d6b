"use strict";
// The map of a report: pictures and sweeps as layers in Leaflet, whose own control switches them.
const facts = JSON.parse(document.getElementById("field-data").textContent);
const [width, height] = facts.size, whole = [[-height, 0], [0, width]], layers = {};
globalThis.map = L.map("map", { crs: L.CRS.Simple, attributionControl: false, zoomSnap: 0.25, minZoom: -6, maxZoom: 6 });
for (const { title, picture, boxes, shown, opacity } of facts.layers) {
  const rectangles = boxes.map(([[y0, y1, x0, x1], words]) => {
    const said = document.createElement("span");
    said.textContent = words; // a tooltip given as text would be read as markup
    return L.rectangle([[-y1, x0], [-y0, x1]], { color: "#fff", weight: 2, fillOpacity: 0.05 }).bindTooltip(said);
  });
  const layer = picture ? L.imageOverlay(picture, whole, { opacity, alt: title }) : L.layerGroup(rectangles);
  layers[title] = shown ? layer.addTo(map) : layer;
}
L.control.layers(null, layers, { collapsed: false }).addTo(map);
map.fitBounds(whole, { animate: false });
map.setMaxBounds(map.getBounds().pad(0.5));
document.getElementById("field").dataset.ready = "yes";
