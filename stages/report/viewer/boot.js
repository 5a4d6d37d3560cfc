// Starts the viewer: unpacks its modules and links them. A page from a file has no folder to import from, so every
// module becomes a blob, and its imports the addresses of the blobs before it.
(async () => {
  const island = (id) => document.getElementById(id).textContent.trim();
  const bytes = (text) => {
    const found = atob(text), out = new Uint8Array(found.length);
    for (let i = 0; i < out.length; i++) out[i] = found.charCodeAt(i);
    return out;
  };
  const unpacked = (id) =>
    new Response(new Blob([bytes(island(id))]).stream().pipeThrough(new DecompressionStream("gzip")));
  try {
    const modules = JSON.parse(await unpacked("viewer-modules").text());
    const urls = {};
    for (const [name, source] of modules) {
      let linked = source;
      for (const known of Object.keys(urls)) linked = linked.replaceAll(`from '${known}'`, `from '${urls[known]}'`);
      urls[name] = URL.createObjectURL(new Blob([linked], { type: "text/javascript" }));
    }
    const { start } = await import(urls["./main.js"]);
    await start(JSON.parse(island("viewer-data")), await unpacked("viewer-glb").arrayBuffer());
    document.documentElement.dataset.viewer = "ready";
  } catch (error) {
    document.documentElement.dataset.viewer = "failed";
    document.getElementById("viewer-status").textContent = `The 3D view can't start here: ${error.message || error}`;
  }
})();
