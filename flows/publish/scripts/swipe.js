"use strict";
// A handle that wipes from one picture to another: a range input, so that mouse, touch and arrow keys all move it.
function swipes(handle, line, moved) {
  const show = () => {
    const share = Number(handle.value) / Number(handle.max);
    line.style.left = 100 * share + "%";
    handle.setAttribute("aria-valuetext", Math.round(100 * share) + " percent of the width");
    moved(share);
  };
  handle.addEventListener("input", show);
  show();
  return show;
}

for (const figure of document.querySelectorAll(".swipe")) {
  const [before] = figure.getElementsByClassName("swipe-before");
  const [line] = figure.getElementsByClassName("swipe-line"), [handle] = figure.getElementsByClassName("swipe-handle");
  swipes(handle, line, (share) => { before.style.clipPath = `inset(0 ${100 - 100 * share}% 0 0)`; });
}
