// The runs of the station, newest first, in pages.

import { ask, element, failure, word } from "./common.js";
import { asked, fillFilter, runsTable } from "./results.js";

const content = document.getElementById("content");
const pager = document.getElementById("pager");
const csv = document.getElementById("csv");
fillFilter(document.getElementById("filter"));

try {
  const query = asked(["limit", "50"]);
  const { runs, next } = await ask(`/api/1/runs?${query}`);
  content.replaceChildren(runs.length ? runsTable(runs) : element("p", { class: "panel" }, word("runs.none")));
  const here = new URLSearchParams(location.search);
  const link = (key, after) => {
    if (after === null) here.delete("after");
    else here.set("after", after);
    return element("a", { class: "button", href: `?${here}` }, word(key));
  };
  if (here.has("after")) pager.append(link("runs.newest", null));
  if (next !== null) pager.append(element("span"), link("runs.older", next));
} catch (error) {
  content.replaceChildren(failure(error));
}
content.removeAttribute("aria-busy");
const all = asked();
all.delete("after");
csv.href = `/api/1/runs.csv?${all}`;
