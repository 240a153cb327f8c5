// Filters: which curves and rows are visible

const form = at("filters");
const chosen = (name) => new Set([...form.querySelectorAll(`[name=${name}]:checked`)].map((box) => box.value));
function shown() {
  const [labels, tasks] = [chosen("label"), chosen("task")];
  return {
    name: form.elements.mode.value + form.elements.entry.value,
    rate: form.elements.entry.value !== "",
    seeds: form.elements.seeds.checked,
    group: (group) => labels.has(group.label) && tasks.has(group.task),
  };
}
function chips(fieldset, name, values, mark) {
  const boxes = values.map((value) => html("input", { type: "checkbox", name, value, checked: true }));
  fieldset.append(...boxes.map((box) => html("label", { class: "chip" }, box, mark(box.value), box.value)));
  if (values.length < 3) return;
  for (const [word, checked] of [
    ["all", true],
    ["none", false],
  ]) {
    const change = () => (boxes.forEach((box) => (box.checked = checked)), update());
    fieldset.append(html("button", { type: "button", "aria-label": `${word} ${name}s`, onclick: change }, word));
  }
}

// Tables. A column is [heading, value for sorting, content of the cell (null: the value), is it a number]

function table(element, columns, entries) {
  const rows = entries.map((entry) => {
    const cells = columns.map(([heading, value, cell, numeric], i) => {
      const about = { class: numeric && "number", scope: !i && "row", "data-heading": heading };
      return html(i ? "td" : "th", about, (cell ?? value)(entry) ?? "–");
    });
    return { entry, element: html("tr", {}, cells) };
  });
  const body = html("tbody");
  body.append(...rows.map((row) => row.element));
  const heads = columns.map(([heading, value, , numeric]) => {
    const sort = () => {
      const again = head.getAttribute("aria-sort") === (numeric ? "descending" : "ascending");
      const down = again ? !numeric : numeric;
      heads.forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const order = (a, b) =>
        a == null ? 1 : b == null ? -1 : (down ? -1 : 1) * (numeric ? a - b : String(a).localeCompare(String(b)));
      body.append(...rows.sort((a, b) => order(value(a.entry), value(b.entry))).map((row) => row.element));
    };
    const head = html(
      "th",
      { class: numeric && "number", scope: "col" },
      html("button", { type: "button", onclick: sort }, heading),
    );
    return head;
  });
  element.replaceChildren(html("thead", {}, html("tr", {}, heads)), body);
  return rows;
}
function finalColumns() {
  const rates = data.groups.some((group) => group.final.sampled_success);
  const best = (name, task) =>
    Math.max(
      ...data.groups.filter((group) => group.task === task).map((group) => group.final[name]?.mean ?? -Infinity),
    );
  const several = (task) => data.groups.filter((group) => group.task === task).length > 1;
  const cell = (name, rate) => (group) => {
    const final = group.final[name];
    if (!final || final.mean == null) return "–";
    const text = withError(final.mean, final.sem, rate);
    const mark = !rate && several(group.task) && final.mean === best(name, group.task);
    const interval =
      rate || !final.interval
        ? null
        : html("small", {}, final.interval.map((end) => plain(end, places(final.mean))).join(" to "));
    return html("span", {}, mark ? html("b", {}, text) : text, interval);
  };
  const seeds = (group) => {
    const diverged = Object.entries(group.diverged).map(
      ([seed, step]) => `seed ${seed} diverged by step ${whole(step)}`,
    );
    const notes = [...diverged, ...(group.unfinished ? ["not finished"] : [])];
    return html("span", {}, String(group.seeds.length), notes.length ? html("small", { class: "wide" }, notes.join("; ")) : null);
  };
  const column = (heading, name, rate) => [heading, (group) => group.final[name]?.mean, cell(name, rate), true];
  return [
    ["agent", (group) => group.label, (group) => html("span", {}, swatch(group.label), " ", group.label)],
    ["task", (group) => group.task],
    ["seeds", (group) => group.seeds.length, seeds, true],
    ["steps", (group) => group.steps, (group) => whole(group.steps), true],
    column("return, sampled actions", "sampled"),
    column("return, mode actions", "mode"),
    ...(rates
      ? [column("success, sampled", "sampled_success", true), column("success, mode", "mode_success", true)]
      : []),
  ];
}
const list = (values) => values.join(", ");
const agentAndTask = (run) => `${run.agent} on ${run.task}`;
const perSecond = (run) => (run.seconds && run.steps ? (run.steps * run.seeds.length) / run.seconds : null);
const perStep = (run) => (run.seconds && run.steps ? (1000 * run.seconds) / run.steps : null);
const device = (run) => list([...new Set(run.sessions.map((session) => session.device))]);
const TIME = [
  ["run", (run) => run.folder],
  ["agent and task", agentAndTask],
  ["seeds", (run) => run.seeds.length, null, true],
  ["steps", (run) => run.steps, (run) => whole(run.steps), true],
  ["wall-clock", (run) => run.seconds, (run) => duration(run.seconds), true],
  ["ms/step", perStep, (run) => plain(perStep(run)), true],
  ["steps/s", perSecond, (run) => plain(perSecond(run)), true],
  ["device", device],
];
const UNFINISHED = [
  ["run", (run) => run.folder],
  ["agent and task", agentAndTask],
  ["seeds", (run) => list(run.seeds)],
  ["steps", (run) => run.steps, (run) => `${whole(run.steps)} of ${whole(run.of)}`, true],
  ["done", (run) => run.steps / run.of, (run) => (run.of ? percent(run.steps / run.of) : "?"), true],
];

// Settings: the details of a run are created when the reader opens them

function settings(run) {
  const changed = run.settings.length ? list(run.settings) : "defaults";
  const fill = ({ target }) => target.open && target.children.length === 1 && target.append(...runDetails(run));
  return html(
    "details",
    { ontoggle: fill },
    html("summary", {}, html("b", {}, run.folder), ` ${agentAndTask(run)}: `, changed),
  );
}
function runDetails(run) {
  const facts = run.sessions.map((session, i) =>
    html(
      "dl",
      {},
      [
        [i ? "resumed" : "started", `${session.started} to ${session.ended}, ${session.device}`],
        ["command", html("code", {}, session.command)],
        ["commit", session.commit],
        ["versions", session.versions],
      ].map(([name, what]) => [html("dt", {}, name), html("dd", {}, what)]),
    ),
  );
  const notes = [
    ...run.diverged,
    ...(run.elsewhere.length
      ? [`seeds ${list(run.elsewhere)} are taken from another run with the same settings`]
      : []),
  ];
  return [
    notes.length ? html("p", { class: "note" }, notes.join("; ")) : null,
    ...facts,
    html("div", { class: "media" }, run.media.map(medium)),
    html("details", {}, html("summary", {}, "full configuration"), html("pre", { tabindex: 0 }, run.config)),
  ].filter(Boolean);
}
function medium({ name, address }) {
  const film = /\.(mp4|webm)$/.test(name);
  const view = film
    ? html("video", { src: address, controls: true, preload: "metadata" })
    : html("img", { src: address, alt: name, loading: "lazy" });
  return html("figure", {}, view, html("figcaption", {}, html("a", { href: address }, name)));
}

// The page

const panels = data.tasks.map((task) => new Panel(task));
const finished = data.runs.filter((run) => run.finished).length;
const seeds = data.groups.reduce((sum, group) => sum + group.seeds.length, 0);
const unfinished = data.runs.filter((run) => !run.finished);
at("about").textContent = [
  plural(data.runs.length, "run") + (unfinished.length ? ` (${finished} finished)` : ""),
  plural(seeds, "seed") + " in the curves",
  plural(data.tasks.length, "task"),
  plural(new Set(data.runs.map((run) => run.agent)).size, "agent"),
  `made ${data.made}`,
  `version ${data.version}`,
].join(" · ");
const names = data.labels.map((label) => label.name);
chips(at("labels"), "label", names, swatch);
chips(at("tasks"), "task", data.tasks, () => null);
at("entries").hidden = !data.groups.some((group) => group.final.sampled_success);
at("curves").append(...panels.map((panel) => panel.figure));
if (!panels.length) at("curves").append(html("p", { class: "note" }, "No run is finished yet."));
const groupRows = table(at("final"), finalColumns(), data.groups);
const runRows = table(at("time"), TIME, data.runs);
const details = data.runs.map((run) => ({ entry: run, element: settings(run) }));
at("settings").append(...details.map((row) => row.element));
at("unfinished-section").hidden = !unfinished.length;
table(at("unfinished"), UNFINISHED, unfinished);
at("unfinished-note").textContent = unfinished.some((run) => run.group != null)
  ? "The curves and the table above include them, up to their last evaluation."
  : "The curves and the table above leave them out.";
at("damage-section").hidden = !data.damage.length;
at("damage").append(...data.damage.map((sentence) => html("li", {}, sentence)));

function update() {
  const view = shown();
  panels.forEach((panel) => panel.update(view));
  groupRows.forEach(({ entry, element }) => (element.hidden = !view.group(entry)));
  const visible = (run) => run.group == null || view.group(data.groups[run.group]);
  [...runRows, ...details].forEach(({ entry, element }) => (element.hidden = !visible(entry)));
}
form.addEventListener("change", update);
update();
