"use strict";
// Figures whose parts know what they show say it: under the pointer, at a tap, and by arrow keys.
(() => {
  for (const figure of document.querySelectorAll("figure")) {
    const parts = [...figure.querySelectorAll("svg .answer")], box = figure.querySelector(".scroll");
    if (!parts.length) continue;
    const said = document.createElement("p");
    let at = -1;
    said.className = "said";
    said.setAttribute("aria-live", "polite");
    box.after(said);
    box.setAttribute("role", "application");
    box.setAttribute("aria-roledescription", "picture");
    box.setAttribute("aria-label", box.getAttribute("aria-label") + " Arrow keys read values.");
    const say = k => {
      parts[at]?.classList.remove("at");
      at = k;
      parts[at]?.classList.add("at");
      said.textContent = parts[at]?.querySelector("title").textContent ?? "";
    };
    for (const name of ["pointerover", "click"]) box.addEventListener(name, event => {
      const part = event.target.closest(".answer");
      if (part) say(parts.indexOf(part));
    });
    box.addEventListener("keydown", event => {
      const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
      if (!step) return;
      say(at < 0 ? (step > 0 ? 0 : parts.length - 1) : (at + step + parts.length) % parts.length);
      event.preventDefault();
    });
  }
})();
