"use strict";
// Draws a spectrum beside the means of classes, as SVG without any markup of words.
const SVG = "http://www.w3.org/2000/svg";
const CHART = { narrow: 340, wide: 760, height: 300, left: 62, right: 12, top: 12, bottom: 44 };

function drawn(name, facts, words) {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(facts)) node.setAttribute(key, value);
  if (words !== undefined) node.textContent = words;
  return node;
}

function niceSteps(low, high, most) {
  const rough = (high - low) / most || 1, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 2.5, 5, 10].map((one) => one * power).find((one) => one >= rough);
  const found = [];
  for (let at = Math.ceil(low / step); at * step <= high + step * 1e-6; at++) found.push(Number((at * step).toPrecision(6)));
  return found;
}

// lines: [{values, colour, kind, name}], values null where there is none; the last is drawn uppermost
function drawSpectrum(into, nm, lines, label) {
  const { height, left, right, top, bottom } = CHART;
  const width = Math.max(CHART.narrow, Math.min(CHART.wide, into.clientWidth));
  const known = lines.flatMap((line) => line.values.filter((value) => value !== null));
  const low = Math.min(0, ...known), high = Math.max(...known, low + 1e-6);
  const first = nm[0], last = nm[nm.length - 1], wide = last - first || 1;
  const x = (at) => left + (width - left - right) * (last > first ? (at - first) / wide : 0.5);
  const y = (value) => height - bottom - (height - top - bottom) * (value - low) / (high - low);
  const svg = drawn("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": label });
  for (const value of niceSteps(low, high, 5)) {
    svg.append(drawn("line", { class: "axis", x1: left, x2: width - right, y1: y(value), y2: y(value) }));
    svg.append(drawn("text", { x: left - 8, y: y(value) + 4, "text-anchor": "end" }, String(value)));
  }
  for (const at of niceSteps(first, last, width / 100)) {
    svg.append(drawn("text", { x: x(at), y: height - bottom + 18, "text-anchor": "middle" }, String(at)));
  }
  svg.append(drawn("text", { x: (left + width - right) / 2, y: height - 6, "text-anchor": "middle" }, "wavelength, nm"));
  const side = drawn("text", { transform: `translate(14 ${(top + height - bottom) / 2}) rotate(-90)`, "text-anchor": "middle" });
  side.textContent = "scene value";
  svg.append(side);
  for (const line of lines) {
    let path = "", pen = false;
    line.values.forEach((value, at) => {
      if (value === null) { pen = false; return; }
      path += `${pen ? "L" : "M"}${x(nm[at]).toFixed(1)} ${y(value).toFixed(1)}`;
      pen = true;
      if (nm.length < 12) {
        svg.append(drawn("circle", { class: line.kind + " dot", cx: x(nm[at]), cy: y(value), r: 3, ...(line.colour && { fill: line.colour }) }));
      }
    });
    const facts = { class: line.kind, d: path, "data-name": line.name };
    if (line.colour) facts.stroke = line.colour;
    svg.append(drawn("path", facts));
    svg.lastChild.append(drawn("title", {}, line.name));
  }
  into.replaceChildren(svg);
}
