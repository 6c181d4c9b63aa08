"use strict";
// Plotly lies packed in the page, a third of its size: unpack and run it.
const plotlyReady = (async () => {
  const text = document.getElementById("plotly").textContent;
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const script = document.createElement("script");
  script.textContent = await new Response(stream).text();
  document.head.append(script);
})();
