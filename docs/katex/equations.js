// Draws the equations that pymdownx.arithmatex marks. KaTeX 0.19.1 (MIT, see LICENSE) lies beside this file, unchanged, so that pages need no network.
for (const place of document.querySelectorAll(".arithmatex")) {
  katex.render(place.textContent.trim().slice(2, -2), place, { displayMode: place.tagName === "DIV", throwOnError: false });
}
