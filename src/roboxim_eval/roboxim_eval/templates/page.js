"use strict";
(() => {
  // Films: one strip of frames each; the script shows one frame at a time.
  const FRAME_MS = 150;
  for (const film of document.querySelectorAll("figure.film")) {
    const [strip, button, slider, screen] = ["img", "button", "input", ".screen"].map((q) => film.querySelector(q));
    const frames = Number(film.dataset.frames);
    let timer = 0;
    const show = (frame) => { slider.value = frame; strip.style.top = `${-100 * frame}%`; };
    const stop = () => { clearInterval(timer); timer = 0; button.textContent = "\u25b6"; button.ariaLabel = "play"; };
    const play = () => {
      if (Number(slider.value) >= frames - 1) show(0);
      button.textContent = "\u275a\u275a"; button.ariaLabel = "pause";
      timer = setInterval(() => { Number(slider.value) >= frames - 1 ? stop() : show(Number(slider.value) + 1); }, FRAME_MS);
    };
    const toggle = () => (timer ? stop() : play());
    button.addEventListener("click", toggle);
    screen.addEventListener("click", toggle);
    slider.addEventListener("input", () => { stop(); show(Number(slider.value)); });
    show(frames - 1);
  }

  // Episodes: a link "#episodes?arm=bc&outcome=failure" lists those with these properties.
  const source = document.getElementById("episode-data");
  if (!source) return;
  const data = JSON.parse(source.textContent);
  const text = (number) => data.texts[number];
  const episodes = data.rows.map((row, number) => {
    const drawn = {};
    for (let i = 0; i < row[11].length; i += 2) drawn[text(row[11][i])] = text(row[11][i + 1]);
    return { number, arm: text(row[0]), replicate: String(row[1]), cell: text(row[2]), scene: text(row[3]), outcome: text(row[4]),
      reason: text(row[5]), instruction: text(row[6]), steps: row[7], bag: row[8], message: row[9], film: row[10], drawn };
  });
  const PAGE = 50;
  const list = document.getElementById("list"), filter = document.getElementById("filter");
  const made = (tag, content, cls) => { const e = document.createElement(tag); if (content) e.textContent = content; if (cls) e.className = cls; return e; };

  const line = (episode) => {
    const details = made("details"), summary = made("summary");
    const tag = made("span", episode.outcome + (episode.reason ? ": " + episode.reason : ""), "tag " + episode.outcome);
    summary.append(tag, " " + episode.instruction + " ", made("span", [episode.arm + (data.replicates ? "." + episode.replicate : ""),
      episode.cell, "scene " + episode.scene, episode.steps + " steps"].filter(Boolean).join(" \u00b7 "), "soft"));
    details.append(summary);
    details.addEventListener("toggle", () => {
      if (!details.open || details.children.length > 1) return;
      const body = made("div");
      if (episode.reason) body.append(made("p", data.reasons[episode.reason] || ""));
      if (episode.message) body.append(made("p", episode.message, "soft"));
      const drawn = Object.entries(episode.drawn).map(([name, value]) => `${name}: ${value}`).join(", ");
      if (drawn) body.append(made("p", "drawn " + drawn, "soft"));
      if (episode.film) { const go = made("a", "film"); go.href = "#film-" + episode.number; body.append(go); }
      if (episode.bag) {
        body.append(made("pre", "roboxim up                       # in one terminal\nroboxim replay " + episode.bag + "   # in another; from the folder of this page"));
      } else body.append(made("p", "No bag of this episode was recorded.", "soft"));
      details.append(body);
    });
    return details;
  };

  const more = (found, from) => {
    for (const episode of found.slice(from, from + PAGE)) list.append(line(episode));
    if (found.length > from + PAGE) {
      const button = made("button", `show ${Math.min(PAGE, found.length - from - PAGE)} more`, "plain");
      button.addEventListener("click", () => { button.remove(); more(found, from + PAGE); });
      list.append(button);
    }
  };

  // A filter: values "a|b" are alternatives, "from 1 to 2" is a range with its ends, "not drawn" a factor that is not there.
  const own = (episode, key) => key === "n" ? episode.number : key in episode && key !== "drawn" ? episode[key]
    : key in episode.drawn ? episode.drawn[key] : Object.keys(episode.drawn).length ? "not drawn" : "";
  const wanted = ([key, value]) => {
    const values = value.split("|"), names = new Set(values);
    const ranges = values.map((one) => /^from (\S+) to (\S+)$/.exec(one)).filter(Boolean).map((r) => [Number(r[1]), Number(r[2])]);
    const shown = values.length < 4 ? values.join(" or ") : `${values.slice(0, 2).join(" or ")} or ${values.length - 2} others`;
    const has = (episode) => {
      const mine = String(own(episode, key)), number = mine === "" ? NaN : Number(mine);
      return names.has(mine) || ranges.some(([low, high]) => number >= low && number <= high);
    };
    return { has, text: `${key === "n" ? "episode" : key} = ${shown}` };
  };

  const show = () => {
    const asked = location.hash.startsWith("#episodes?");
    const query = asked ? [...new URLSearchParams(location.hash.slice(10))].map(wanted) : [];
    const found = episodes.filter((episode) => query.every((one) => one.has(episode)));
    const solved = found.filter((episode) => episode.outcome === "success").length;
    filter.replaceChildren(made("b", `${found.length} episodes, ${solved} succeeded`));
    for (const one of query) filter.append(made("span", one.text, "chip"));
    if (query.length) {
      const all = made("button", "show all", "plain");
      all.addEventListener("click", () => { history.pushState(null, "", "#episodes"); show(); });
      filter.append(all);
    } else {
      for (const outcome of ["success", "failure", "error"]) {
        if (!episodes.some((episode) => episode.outcome === outcome)) continue;
        const go = made("a", outcome, "chip"); go.href = "#episodes?outcome=" + outcome; filter.append(go);
      }
    }
    list.replaceChildren();
    more(found, 0);
    if (asked) {
      document.getElementById("episodes").scrollIntoView();
      if (found.length === 1) list.querySelector("details").open = true;
    }
  };
  addEventListener("hashchange", show);
  document.addEventListener("click", (event) => {
    const number = event.target.dataset && event.target.dataset.e;
    if (number !== undefined) location.hash = "#episodes?n=" + number;
  });
  show();
})();
