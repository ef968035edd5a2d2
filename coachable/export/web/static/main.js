// Start of the page: an agent that acts in the browser, or recordings of one.

import { at, megabytes } from "./dom.js";
import { fetched } from "./page.js";

async function start() {
  const manifest = await (await fetched("manifest.json")).json();
  document.title = `${manifest.title} – coachable`;
  at("title").textContent = manifest.title;
  at("summary").textContent = manifest.summary;
  if (manifest.home) Object.assign(at("documentation"), { href: manifest.home, hidden: false });
  tellLoads(manifest);
  const kind = await import(`./${manifest.kind}.js`);
  await kind.start(manifest);
}

function tellLoads(manifest) {
  const total = manifest.downloads.reduce((sum, { bytes }) => sum + bytes, 0);
  const versions = manifest.packages.map(({ name, version, license }) => `${name} ${version} (${license})`).join(", ");
  const agent = `agent (coachable ${manifest.coachable_version}, domain ${manifest.domain})`;
  const content = manifest.kind === "recorded" ? `recordings of the ${agent}` : `the ${agent}, its physics`;
  at("loads").textContent =
    `${megabytes(total)} from this site and nothing from any other: ${content}, and ${versions}. Nothing is sent anywhere.`;
  for (const { file, bytes } of manifest.downloads) {
    const row = at("files").insertRow();
    row.insertCell().textContent = file;
    row.insertCell().textContent = bytes < 1e5 ? `${Math.ceil(bytes / 1e3)} kB` : megabytes(bytes);
  }
}

try {
  await start();
} catch (error) {
  console.error(error);
  at("loading-bar").hidden = true;
  at("loading-text").setAttribute("role", "alert");
  at("loading-text").textContent = `The page could not start: ${error.message}`;
}
