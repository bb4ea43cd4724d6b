"use strict";
// The map of a report: layers in Leaflet, classes painted from their numbers, what lies under the pointer in words.
const ORDER = ["colour", "classes", "confidence", "truth", "before", "age", "changed", "seats", "sweeps"];
const PAINTED = ["classes", "truth", "before"];

class FieldMap {
  constructor(facts) {
    this.facts = facts;
    [this.width, this.height] = facts.size;
    this.off = new Set(); // classes that are not shown
    this.layers = {};
    this.map = L.map("map", {
      crs: L.CRS.Simple, attributionControl: false, zoomSnap: 0.25, minZoom: -6, maxZoom: 6, keyboardPanDelta: 60,
      zoomAnimation: !matchMedia("(prefers-reduced-motion: reduce)").matches,
    });
    this.bounds = this.box([0, this.height, 0, this.width]);
    this.whole();
    this.map.setMaxBounds(this.bounds.pad(0.5));
    this.map.on("zoomend", () => this.sharpen());
    this.sharpen();
  }

  // rows and columns, half open, as Leaflet's corners: its first coordinate grows upwards
  box([y0, y1, x0, x1]) { return L.latLngBounds([[-y1, x0], [-y0, x1]]); }

  whole() { this.map.fitBounds(this.bounds, { animate: false, padding: [6, 6] }); }

  sharpen() { this.map.getContainer().classList.toggle("near", this.map.getZoom() > 0.5); }

  async read() {
    const { facts } = this, still = document.getElementById("still").src;
    const packed = { classes: still.slice(still.indexOf(",") + 1), truth: facts.truth, before: facts.before };
    this.numbers = {};
    for (const key of [...PAINTED, "confidence"]) {
      const content = key === "confidence" ? facts.confidence : packed[key];
      if (content) this.numbers[key] = await readPng(content);
    }
    for (const key of ["changed", "age"]) if (facts[key]) this.numbers[key] = await readPng(facts[key]);
    if (facts.spectra) this.spectra = (await readPng(facts.spectra.png)).data;
  }

  lay() {
    for (const key of ORDER) {
      const pane = this.map.createPane(key);
      pane.style.zIndex = 300 + ORDER.indexOf(key);
      const layer = this.made(key);
      if (layer) this.layers[key] = layer;
    }
    for (const box of document.querySelectorAll("[data-layer]")) {
      box.addEventListener("change", () => this.toggle(box.dataset.layer, box.checked));
      this.toggle(box.dataset.layer, box.checked);
    }
    for (const slider of document.querySelectorAll("[data-opacity]")) {
      const fade = () => { this.map.getPane(slider.dataset.opacity).style.opacity = slider.value / 100; };
      slider.addEventListener("input", fade);
      fade();
    }
    for (const box of document.querySelectorAll("[data-class]")) {
      box.addEventListener("change", () => {
        this.off[box.checked ? "delete" : "add"](Number(box.dataset.class));
        for (const key of PAINTED) if (this.numbers[key]) this.paint(key);
        if (this.chosen) this.tell(this.chosen);
      });
    }
    document.getElementById("whole").addEventListener("click", () => this.whole());
  }

  made(key) {
    const { facts } = this, pane = key, seats = facts.patch;
    if (PAINTED.includes(key)) {
      if (!this.numbers[key]) return null;
      const canvas = document.createElement("canvas");
      canvas.width = this.numbers[key].width;
      canvas.height = this.numbers[key].height;
      this.numbers[key].canvas = canvas;
      this.paint(key);
      return L.svgOverlay(canvas, this.bounds, { pane }); // any element will do
    }
    if (key === "sweeps") {
      const group = L.layerGroup([], { pane }), count = facts.sweeps.length;
      facts.sweeps.forEach((sweep, at) => {
        const hue = 265 - 215 * (count > 1 ? at / (count - 1) : 1);
        group.addLayer(L.rectangle(this.box(sweep.box), {
          pane, color: `hsl(${hue} 90% 55%)`, weight: 2, fillOpacity: 0.06, interactive: false,
          dashArray: sweep.kind === "coarse" ? "6 5" : null,
        }));
      });
      return group;
    }
    if (!facts[key]) return null;
    const kind = key === "colour" ? "jpeg" : "png";
    let bounds = this.bounds;
    if (["seats", "changed", "age"].includes(key)) {
      bounds = this.box([0, Math.ceil(this.height / seats) * seats, 0, Math.ceil(this.width / seats) * seats]);
    }
    return L.imageOverlay(`data:image/${kind};base64,${facts[key]}`, bounds, { pane });
  }

  paint(key) {
    const { canvas, data, width, height } = this.numbers[key], { colours } = this.facts, none = colours.length - 1;
    const pen = canvas.getContext("2d"), image = pen.createImageData(width, height);
    const table = new Uint32Array(256), view = new DataView(table.buffer);
    for (let number = 0; number < 256; number++) {
      const shown = Math.min(number, none), [red, green, blue] = colours[shown];
      [red, green, blue, this.off.has(shown) ? 0 : 255].forEach((part, at) => view.setUint8(4 * number + at, part));
    }
    const pixels = new Uint32Array(image.data.buffer);
    for (let at = 0; at < data.length; at++) pixels[at] = table[data[at]];
    pen.putImageData(image, 0, 0);
  }

  toggle(key, on) {
    const layer = this.layers[key];
    if (!layer) return;
    if (on) layer.addTo(this.map); else layer.remove();
    if (key === "before") this.swipe();
  }

  // the map of before is cut off at the handle, which stands still while the map below it moves
  swipe() {
    const handle = document.getElementById("map-swipe"), line = document.getElementById("map-line");
    const wiping = document.getElementById("swiping");
    if (!handle || !wiping || !this.layers.before) return;
    const cut = (share) => {
      const pane = this.map.getPane("before"), on = wiping.checked && this.map.hasLayer(this.layers.before);
      handle.hidden = line.hidden = !on;
      if (!on) { pane.style.clipPath = ""; return; }
      const size = this.map.getSize(), corner = this.map.containerPointToLayerPoint([0, 0]);
      const [top, left] = [corner.y - size.y, corner.x - size.x], right = corner.x + share * size.x;
      const bottom = corner.y + 2 * size.y;
      pane.style.clipPath = `polygon(${left}px ${top}px, ${right}px ${top}px, ${right}px ${bottom}px, ${left}px ${bottom}px)`;
    };
    if (!this.cutting) {
      this.cutting = swipes(handle, line, cut);
      this.map.on("move zoom viewreset resize", this.cutting);
      wiping.addEventListener("change", this.cutting);
    }
    this.cutting();
  }

  at(key, y, x) {
    const found = this.numbers[key];
    if (!found) return null;
    const side = key === "changed" || key === "age" ? this.facts.patch : this.facts.step;
    const row = Math.min(Math.floor(y / side), found.height - 1), column = Math.min(Math.floor(x / side), found.width - 1);
    return found.data[row * found.width + column];
  }

  named(number) { return number < this.facts.names.length ? this.facts.names[number] : "no class"; }

  place(y, x) {
    const { places } = this.facts;
    if (!places) return "";
    const [rows, columns] = places.nodes;
    const v = (y + 0.5) / this.height * (rows - 1), u = (x + 0.5) / this.width * (columns - 1);
    const row = Math.min(Math.floor(v), rows - 2), column = Math.min(Math.floor(u), columns - 2);
    const between = (list, part) => {
      let sum = 0;
      for (const [down, across] of [[0, 0], [0, 1], [1, 0], [1, 1]]) {
        const value = list[2 * ((row + down) * columns + column + across) + part];
        if (value === null) return null;
        sum += value * (down ? v - row : 1 - v + row) * (across ? u - column : 1 - u + column);
      }
      return sum;
    };
    const [lon, lat, east, north] = [between(places.lonlat, 0), between(places.lonlat, 1), between(places.map, 0), between(places.map, 1)];
    if (lon === null || lat === null) return "no ground";
    const degrees = `${Math.abs(lat).toFixed(7)}° ${lat < 0 ? "S" : "N"}, ${Math.abs(lon).toFixed(7)}° ${lon < 0 ? "W" : "E"}`;
    return east === null || Math.abs(east) <= 360 ? degrees : `${degrees} (${east.toFixed(2)}, ${north.toFixed(2)})`;
  }

  words(y, x) {
    const said = [`x ${x}, y ${y}`], sure = this.at("confidence", y, x);
    let what = this.named(this.at("classes", y, x));
    if (sure !== null && sure <= 100) what += ` (${sure} %)`;
    said.push(what);
    for (const [key, title] of [["truth", "truth"], ["before", "before"]]) {
      if (this.numbers[key]) said.push(`${title}: ${this.named(this.at(key, y, x))}`);
    }
    const changed = this.at("changed", y, x), age = this.at("age", y, x);
    if (changed) said.push(`${changed} % of this place changed`);
    if (age !== null && age <= 100) said.push(`looked at ${(age / 100 * this.facts.oldest).toPrecision(2)} days ago`);
    const sweep = this.facts.sweeps.findLast(({ box: [y0, y1, x0, x1] }) => y >= y0 && y < y1 && x >= x0 && x < x1);
    if (sweep) said.push(sweep.words);
    const place = this.place(y, x);
    if (place) said.push(place);
    return said.join(" · ");
  }

  pixel(latlng) {
    const [y, x] = [Math.floor(-latlng.lat), Math.floor(latlng.lng)];
    return y >= 0 && x >= 0 && y < this.height && x < this.width ? { y, x } : null;
  }

  spectrum(y, x) {
    const { spectra } = this.facts;
    if (!spectra) return null;
    const [height, width, bands] = spectra.shape;
    const row = Math.min(Math.floor(y / spectra.pixel), height - 1), column = Math.min(Math.floor(x / spectra.pixel), width - 1);
    const first = (row * width + column) * bands;
    return spectra.low.map((low, band) => {
      const level = this.spectra[first + band];
      return level === 255 ? null : low + level * spectra.step[band];
    });
  }

  tell(place) {
    this.chosen = place;
    const { y, x } = place, { spectra, names, colours } = this.facts, words = this.words(y, x);
    document.getElementById("readout").textContent = words;
    const here = this.spectrum(y, x), mine = this.at("classes", y, x), said = document.getElementById("said");
    if (this.mark) this.mark.remove();
    this.mark = L.circleMarker([-y - 0.5, x + 0.5], { radius: 7, color: "#fff", weight: 3, fillColor: "#000", fillOpacity: 0.6, interactive: false }).addTo(this.map);
    if (!here) { said.textContent = words; return; }
    const css = (number) => `rgb(${colours[number].join(" ")})`;
    const means = names.map((name, number) => ({ number, name: `mean of ${name}, ${spectra.sizes[number]} places`, values: spectra.means[number], colour: css(number) }))
      .filter((line) => line.values && !this.off.has(line.number))
      .map((line) => ({ ...line, kind: line.number === mine ? "mean same" : "mean" }))
      .sort((one, other) => (one.number === mine) - (other.number === mine));
    const name = `spectrum at x ${x}, y ${y}`;
    const label = `${name}, mapped as ${this.named(mine)}, beside the means of ${means.length} classes`;
    drawSpectrum(document.getElementById("spectrum"), spectra.nm, [...means, { values: here, colour: "", kind: "here", name }], label);
    said.textContent = here.some((value) => value !== null)
      ? `Spectrum at x ${x}, y ${y}, mapped as ${this.named(mine)} (thick line); thin: means of classes.`
      : `Nothing was captured at x ${x}, y ${y}.`;
  }

  listen() {
    const stage = document.querySelector(".stage"), readout = document.getElementById("readout");
    this.map.on("mousemove", (event) => {
      const place = this.pixel(event.latlng);
      if (place) readout.textContent = this.words(place.y, place.x);
    });
    this.map.on("click", (event) => {
      stage.classList.remove("by-keys");
      const place = this.pixel(event.latlng);
      if (place) this.tell(place);
    });
    this.map.getContainer().addEventListener("keydown", (event) => {
      stage.classList.add("by-keys");
      if (event.key !== "Enter" || event.target !== this.map.getContainer()) return;
      event.preventDefault();
      const place = this.pixel(this.map.getCenter());
      if (place) this.tell(place);
    });
    this.map.on("moveend", () => {
      const place = this.pixel(this.map.getCenter());
      if (place && stage.classList.contains("by-keys")) readout.textContent = this.words(place.y, place.x);
    });
  }
}

async function showField() {
  const section = document.getElementById("field");
  if (typeof DecompressionStream === "undefined") return; // the picture stays
  document.documentElement.classList.add("has-map");
  for (const part of section.querySelectorAll(".moving")) part.hidden = false;
  globalThis.field = new FieldMap(JSON.parse(document.getElementById("field-data").textContent));
  await field.read();
  field.lay();
  field.listen();
  section.dataset.ready = "yes";
}

showField();
