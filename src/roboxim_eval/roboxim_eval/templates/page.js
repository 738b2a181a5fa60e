"use strict";
(() => {
  // Films: strips of frames; the script shows one frame at a time, and tells others which.
  const films = (screen, button, slider, heard) => {
    const frames = Number(screen.dataset.frames), strips = [...screen.querySelectorAll("img")];
    const each = Math.ceil(frames / Math.max(1, strips.length)), ms = Number(screen.dataset.ms);
    let timer = 0;
    const show = (frame) => {
      slider.value = frame;
      strips.forEach((strip, number) => { strip.style.visibility = number === Math.floor(frame / each) ? "visible" : "hidden"; });
      if (strips.length) strips[Math.floor(frame / each)].style.top = `${-100 * (frame % each)}%`;
      if (heard) heard(frame);
    };
    const stop = () => { clearInterval(timer); timer = 0; button.textContent = "\u25b6"; button.ariaLabel = "play"; };
    const play = () => {
      const from = Number(slider.value) >= frames - 1 ? 0 : Number(slider.value), began = performance.now();
      button.textContent = "\u275a\u275a"; button.ariaLabel = "pause";
      timer = setInterval(() => {
        const frame = Math.min(frames - 1, from + Math.floor((performance.now() - began) / ms));
        if (frame !== Number(slider.value)) show(frame);
        if (frame === frames - 1) stop();
      }, Math.max(15, ms / 2));
      show(from);
    };
    const toggle = () => (timer ? stop() : play());
    button.addEventListener("click", toggle);
    screen.addEventListener("click", toggle);
    slider.addEventListener("input", () => { stop(); show(Number(slider.value)); });
    show(Number(slider.value));
    return { show: (frame) => { stop(); show(Math.max(0, Math.min(frames - 1, frame))); }, toggle, at: () => Number(slider.value) };
  };
  for (const film of document.querySelectorAll(".films figure.film")) {
    films(...[".screen", ".controls button", "input"].map((q) => film.querySelector(q)));
  }
  const course = document.getElementById("course");
  if (course) follow(course, films);

  // Tables of which a reader wants one at a time.
  for (const tabs of document.querySelectorAll(".tabs")) {
    const sections = [...tabs.querySelectorAll("section")], bar = document.createElement("div");
    if (sections.length < 2) continue;
    bar.className = "tab-bar";
    const choose = (chosen) => sections.forEach((section, number) => {
      section.hidden = number !== chosen; bar.children[number].ariaPressed = String(number === chosen);
    });
    sections.forEach((section, number) => {
      const button = document.createElement("button");
      button.type = "button"; button.className = "plain"; button.textContent = section.dataset.tab;
      button.addEventListener("click", () => choose(number)); bar.append(button);
    });
    tabs.prepend(bar); choose(0);
  }

  // A link into a folded part opens it; a printed page has no folded part.
  const unfold = (element) => { for (let e = element; e; e = e.parentElement) if (e.tagName === "DETAILS") e.open = true; };
  const go = () => {
    const id = decodeURIComponent(location.hash.slice(1).split("?")[0]), target = id && document.getElementById(id);
    if (target) { unfold(target); target.scrollIntoView(); }
  };
  addEventListener("hashchange", go);
  addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((one) => { one.open = true; }));
  go();

  // Episodes: a link "#episodes?arm=bc&outcome=failure" lists those with these properties.
  const source = document.getElementById("episode-data");
  if (!source) return;
  const data = JSON.parse(source.textContent);
  const text = (number) => data.texts[number];
  const episodes = data.rows.map((row, number) => {
    const drawn = {};
    for (let i = 0; i < row[11].length; i += 2) drawn[text(row[11][i])] = text(row[11][i + 1]);
    return { number, arm: text(row[0]), replicate: String(row[1]), cell: text(row[2]), scene: text(row[3]), outcome: text(row[4]),
      reason: text(row[5]), instruction: text(row[6]), steps: row[7], bag: row[8], message: row[9], film: row[10], drawn,
      explanation: row[12], page: row[13] };
  });
  const PAGE = 50, MAX_COLUMNS = 4;
  const list = document.getElementById("list"), filter = document.getElementById("filter"), search = document.getElementById("search");
  const made = (tag, content, cls) => { const e = document.createElement(tag); if (content) e.textContent = content; if (cls) e.className = cls; return e; };
  const linked = (content, href) => { const a = made("a", content); a.href = href; return a; };
  document.getElementById("count").textContent = `${episodes.length}`;

  // Rows: a scene with a column for each policy that met it, or an episode where policies are many or met different scenes.
  const arms = [...new Set(episodes.map((e) => e.arm))];
  const scenes = new Map();
  for (const e of episodes) {
    const key = [e.replicate, e.cell, e.scene].join("\n");
    scenes.set(key, [...(scenes.get(key) || []), e]);
  }
  const paired = arms.length > 1 && arms.length <= MAX_COLUMNS && [...scenes.values()].every((s) => new Set(s.map((e) => e.arm)).size === s.length);
  const groups = paired ? [...scenes.values()] : episodes.map((e) => [e]);
  const varies = (of) => new Set(episodes.map(of)).size > 1;
  const number = (value) => (value !== "" && !isNaN(value) ? Number(value) : value);
  const columns = [{ name: "scene", of: (g) => g[0].scene }];
  if (varies((e) => e.cell)) columns.push({ name: "cell", of: (g) => g[0].cell });
  if (varies((e) => e.replicate)) columns.push({ name: "training", of: (g) => g[0].replicate });
  columns.push({ name: "instruction", of: (g) => g[0].instruction });
  if (!paired && arms.length > 1) columns.push({ name: "policy", of: (g) => g[0].arm });
  for (const arm of paired ? arms : [""]) {
    columns.push({ name: arm || "outcome", arm, of: (g) => { const e = arm ? g.find((one) => one.arm === arm) : g[0]; return e ? `${e.outcome} ${e.reason} ${e.steps}` : ""; } });
    if (!paired) columns.push({ name: "steps", of: (g) => g[0].steps });
  }
  const SIGN = { success: "\u2713", failure: "\u2717", error: "!" };
  let order = { column: -1, down: false }, wanted = [], found = [];

  const outcome = (episode, cls) => {
    const td = made("td", "", cls);
    if (!episode) { td.textContent = "-"; return td; }
    td.append(made("span", `${SIGN[episode.outcome]} ${episode.outcome}`, "mark-of " + episode.outcome),
      episode.reason ? ` ${episode.reason.replaceAll("_", " ")}` : "", paired ? made("span", ` ${episode.steps} steps`, "soft") : "");
    return td;
  };

  const explained = (episode) => {
    const body = made("div");
    const title = made("p"); title.append(made("b", paired ? episode.arm : ""), ` ${episode.explanation || data.reasons[episode.reason] || ""}`); body.append(title);
    if (episode.explanation && episode.reason) body.append(made("p", data.reasons[episode.reason], "soft"));
    if (episode.message) body.append(made("p", episode.message, "soft"));
    const drawn = Object.entries(episode.drawn).map(([name, value]) => `${name}: ${value}`).join(", ");
    if (drawn) body.append(made("p", "drawn " + drawn, "soft"));
    const links = made("p");
    if (episode.page) links.append(linked("why: film, actions, conditions", episode.page), " ");
    if (episode.film) links.append(linked("its film", "#film-" + episode.number));
    if (episode.bag) links.append(" ", linked("its bag", episode.bag + "/"));
    if (links.children.length) body.append(links);
    if (episode.bag) {
      body.append(made("pre", "roboxim show " + episode.bag + "   # why it ended so; from the folder of this page\nroboxim studio " + episode.bag + "   # in 3D, tick by tick, what if\nroboxim up                       # in one terminal\nroboxim replay " + episode.bag + "   # in another: executes it again"));
    } else body.append(made("p", "No bag of this episode was recorded.", "soft"));
    return body;
  };

  const row = (group) => {
    const tr = made("tr", "", "row"), mine = group.filter((e) => wanted.every((one) => one.has(e)));
    tr.tabIndex = 0;
    for (const column of columns) {
      if (!("arm" in column)) { tr.append(made("td", String(column.of(group)), column.name)); continue; }
      const episode = column.arm ? group.find((e) => e.arm === column.arm) : group[0];
      tr.append(outcome(episode, episode && !mine.includes(episode) ? "other" : ""));
    }
    let detail = null;
    const toggle = () => {
      if (detail) { detail.remove(); detail = null; return; }
      detail = made("tr", "", "detail");
      const td = made("td"); td.colSpan = columns.length;
      for (const episode of mine) td.append(explained(episode));
      detail.append(td); tr.after(detail);
    };
    tr.addEventListener("click", toggle);
    tr.addEventListener("keydown", (event) => { if (event.key === "Enter" || event.key === " ") { event.preventDefault(); toggle(); } });
    return { tr, toggle };
  };

  const more = (body, from) => {
    const rows = found.slice(from, from + PAGE).map(row);
    for (const one of rows) body.append(one.tr);
    if (found.length > from + PAGE) {
      const button = made("button", `show ${Math.min(PAGE, found.length - from - PAGE)} more`, "plain");
      button.addEventListener("click", () => { button.remove(); more(body, from + PAGE); });
      list.append(button);
    }
    return rows;
  };

  const head = () => {
    const tr = made("tr");
    columns.forEach((column, place) => {
      const th = made("th", "", column.arm === undefined ? column.name : ""), button = made("button", column.name);
      button.type = "button";
      if (order.column === place) th.ariaSort = order.down ? "descending" : "ascending";
      button.addEventListener("click", () => { order = { column: place, down: order.column === place && !order.down }; table(); });
      th.append(button); tr.append(th);
    });
    return tr;
  };

  const table = () => {
    const words = (search.value || "").toLowerCase();
    const said = (e) => [e.instruction, e.arm, e.cell, e.outcome, e.reason, e.explanation, ...Object.values(e.drawn)].join(" ").toLowerCase();
    found = groups.filter((group) => group.some((e) => wanted.every((one) => one.has(e)) && (!words || said(e).includes(words))));
    if (order.column >= 0) {
      const of = columns[order.column].of, sign = order.down ? -1 : 1;
      const compare = (a, b) => (typeof a === "number" && typeof b === "number" ? a - b : String(a).localeCompare(String(b)));
      found.sort((one, other) => sign * compare(number(of(one)), number(of(other))));
    }
    const whole = made("table"), top = made("thead"), body = made("tbody");
    top.append(head()); whole.append(top, body);
    list.replaceChildren(whole);
    const rows = more(body, 0);
    if (rows.length === 1) rows[0].toggle();
  };

  // A filter: values "a|b" are alternatives, "from 1 to 2" is a range with its ends, "not drawn" a factor that is not there.
  const own = (episode, key) => key === "n" ? episode.number : key in episode && key !== "drawn" ? episode[key]
    : key in episode.drawn ? episode.drawn[key] : Object.keys(episode.drawn).length ? "not drawn" : "";
  const asked = ([key, value]) => {
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
    wanted = location.hash.startsWith("#episodes?") ? [...new URLSearchParams(location.hash.slice(10))].map(asked) : [];
    const mine = episodes.filter((episode) => wanted.every((one) => one.has(episode)));
    const solved = mine.filter((episode) => episode.outcome === "success").length;
    filter.replaceChildren(made("b", `${mine.length} episodes, ${solved} succeeded`));
    for (const one of wanted) filter.append(made("span", one.text, "chip"));
    if (wanted.length) {
      const all = made("button", "show all", "plain");
      all.addEventListener("click", () => { history.pushState(null, "", "#episodes"); show(); });
      filter.append(all);
    } else {
      for (const outcome of ["success", "failure", "error"]) {
        if (!episodes.some((episode) => episode.outcome === outcome)) continue;
        const go = linked(outcome, "#episodes?outcome=" + outcome); go.className = "chip"; filter.append(go);
      }
    }
    table();
  };
  addEventListener("hashchange", show);
  search.addEventListener("input", table);
  document.addEventListener("click", (event) => {
    const number = event.target.dataset && event.target.dataset.e;
    if (number !== undefined) location.hash = "#episodes?n=" + number;
  });
  show();
})();
