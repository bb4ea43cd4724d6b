"use strict";
// Plays a field's visits, and shows two of them beside each other.
const visits = JSON.parse(document.getElementById("visits").textContent);
const which = document.getElementById("which"), play = document.getElementById("play");
const pictured = (content) => "data:image/png;base64," + content;
let timer = null;

function show() {
  const one = visits[Number(which.value)], changes = document.getElementById("changes");
  document.getElementById("visit").src = pictured(one.map);
  changes.hidden = !one.changes;
  if (one.changes) changes.src = pictured(one.changes);
  document.getElementById("said").textContent = one.when + ": " + one.words;
}

function stop() { clearInterval(timer); timer = null; play.textContent = "Play"; }

which.addEventListener("input", () => { stop(); show(); });
play.addEventListener("click", () => {
  if (timer !== null) { stop(); return; }
  if (Number(which.value) === visits.length - 1) which.value = 0;
  show(); play.textContent = "Stop";
  timer = setInterval(() => {
    if (Number(which.value) === visits.length - 1) { stop(); return; }
    which.value = Number(which.value) + 1; show();
  }, 700);
});

const sides = ["left", "right"].map((side) => document.getElementById(side));
function showTwo() {
  for (const side of sides) document.getElementById(side.id + "-map").src = pictured(visits[Number(side.value)].map);
  const [left, right] = sides.map((side) => visits[Number(side.value)].when);
  document.getElementById("two").textContent = `Left ${left}, right ${right}.`;
}
if (sides[0]) {
  for (const side of sides) side.addEventListener("change", showTwo);
  showTwo();
}
