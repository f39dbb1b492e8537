// Connection, newest values and time line; each other module shows one part of them.
import { Attitude } from "/page/attitude.js";
import { Commander, Parameters } from "/page/commands.js";
import { KeptFrame } from "/page/frames.js";
import { setUpKeys } from "/page/keys.js";
import { Events, Frames, History, setZero } from "/page/lists.js";
import { GroundTrack } from "/page/map.js";
import { Files, Passes } from "/page/panels.js";
import { setUpTheme } from "/page/theme.js";
import { Health, Packets, beyond, fieldOf, label } from "/page/values.js";
import { Plots } from "/page/plots.js";

const DEAD_AFTER = 2.5; // s without telemetry or without a message of the console; a look each 0.25 s turns the light red within 3 s
const byId = (name) => document.getElementById(name);
setUpTheme(byId("theme"));
const readTable = async () => (await fetch("/api/table")).json();
let table = await readTable();
const modes = fieldOf(table, "health", "mode");
const newest = {};
const state = { time: 0, span: [0, 0], live: true, speed: 1, silence: 0, flight_silence: 0, surroundings: null };
let receivedAt = 0;
let line = null;
let seeking = false;
let unknown = false; // the console no longer knows this page
let opened = false; // the page has been connected once: only the first connection shows the moment of the address

byId("name").textContent = table.name;
document.title = `${table.name} - KnightCube console`;
const commander = new Commander(table, { form: byId("command"), which: byId("which"), inputs: byId("inputs"), safe: byId("safe"), answer: byId("answer"), dialog: byId("confirm") });
const views = [
  new Attitude(byId("attitude"), byId("legend"), table),
  new Health(byId("health"), table),
  new Packets(byId("packets"), byId("all"), table),
  new Events(byId("events"), byId("severity"), byId("filter"), fieldOf(table, "event", "severity"), table.endings, fieldOf(table, "health", "facts")),
  new Frames(byId("frames")),
  new KeptFrame(byId("frame"), byId("frames")),
  new History(byId("commands"), fieldOf(table, "verification", "stage")),
  commander,
  new Parameters(byId("parameters-panel"), table, commander),
  new Files(byId("files"), table, commander),
];
if (table.orbit) {
  byId("orbit").hidden = false;
  views.push(new GroundTrack(byId("map"), byId("place")));
}
new Passes(byId("passes"), table, commander, () => state);
const plots = new Plots({ place: byId("panels"), adder: byId("add"), span: byId("window"), unzoom: byId("unzoom"), parameters: byId("parameters") }, table, () => state);
plots.newest = () => newest;

function connect() {
  line = new WebSocket(`ws://${location.host}/api/live`);
  line.onopen = () => {
    if (!opened) moment(); else if (!state.live) move(state.time, state.speed);
    opened = true;
  };
  line.onmessage = (message) => take(JSON.parse(message.data));
  line.onclose = async () => {
    // After a restart the console has other tokens. A WebSocket only fails, but a request gets the reason.
    const answer = await fetch("/api/table").catch(() => null);
    if (answer?.status !== 401) { setTimeout(connect, 1000); return; }
    unknown = true;
    byId("trouble").hidden = false;
    byId("trouble").textContent = "The console was started again and does not know this page: open the newest address that it printed.";
  };
}

function take(said) {
  receivedAt = performance.now();
  if (said.again) for (const name of Object.keys(newest)) delete newest[name];
  Object.assign(newest, said.newest);
  Object.assign(state, { time: said.time, span: said.span, live: said.live, speed: said.speed, silence: said.silence, flight_silence: said.flight_silence,
    surroundings: said.surroundings, utc_ns: said.utc_ns, omitted: said.omitted });
  setZero(said.utc_ns === null ? null : said.utc_ns / 1e6 - said.time * 1e3);
  for (const view of views) view.show(newest, state, said.listed, said.again);
  if (said.body !== table.body) learn(said.body);
  byId("trouble").hidden = !said.trouble;
  byId("trouble").textContent = said.trouble;
  const mode = newest.attitude?.mode ?? newest.health?.mode ?? newest.mode?.mode;
  byId("mode").textContent = mode === undefined ? "-" : label(mode, modes);
  byId("mode").classList.toggle("safe", beyond(mode, modes) !== "");
  byId("time").textContent = `${said.time.toFixed(1)} s`;
  byId("utc").textContent = said.utc_ns === null ? "" : new Date(said.utc_ns / 1e6).toISOString().slice(0, 19) + "Z";
  if (!seeking) byId("seek").value = String(1000 * (said.time - said.span[0]) / Math.max(said.span[1] - said.span[0], 1e-9));
  byId("live").classList.toggle("chosen", said.live);
  byId("play").textContent = atEnd() ? "replay" : said.live || said.speed > 0 ? "pause" : "play";
  document.body.dataset.time = String(said.time);
}

// By a link without a configuration, the kind of body is known from its first packets.
async function learn(body) {
  table.body = body;
  table = await readTable();
  commander.offer(table);
}

// A flight that has ended says so in its last event; a log that just stops is a dead link.
function light() {
  const silent = (performance.now() - receivedAt) / 1000;
  const ended = newest.event?.name === "stopped";
  const [kind, words] = unknown ? ["dead", "address stale"] : silent > DEAD_AFTER || line.readyState !== WebSocket.OPEN ? ["dead", "console lost"]
    : !state.live ? ["past", state.speed > 0 ? `replay ${state.speed} x` : "replay, paused"]
    : ended ? ["over", "flight ended"]
    : state.silence > DEAD_AFTER ? ["dead", `no telemetry for ${state.silence.toFixed(0)} s`]
    : state.flight_silence > DEAD_AFTER ? ["dead", `link alive, flight silent for ${state.flight_silence.toFixed(0)} s`] : ["alive", "live"];
  byId("light").className = `light ${kind}`;
  byId("light").textContent = words;
}

function move(at, speed) {
  if (line.readyState === WebSocket.OPEN) line.send(JSON.stringify({ at, speed }));
}
const chosenSpeed = () => Number(byId("speed").value);
byId("live").onclick = () => line.send(JSON.stringify({ live: true }));
// At the end of a flight, play begins at its start.
const atEnd = () => state.time > state.span[1] - 0.05 && (state.live ? newest.event?.name === "stopped" : state.speed === 0);
byId("play").onclick = () => {
  if (atEnd()) move(state.span[0], chosenSpeed());
  else move(state.time, state.live || state.speed > 0 ? 0 : chosenSpeed());
};
// A paused replay stays paused; the speed applies when it is played.
byId("speed").onchange = () => { if (!state.live && state.speed > 0) move(state.time, chosenSpeed()); };
byId("seek").oninput = () => {
  seeking = true;
  const share = Number(byId("seek").value) / 1000;
  move(state.span[0] + share * (state.span[1] - state.span[0]), 0);
};
byId("seek").onchange = () => { seeking = false; };

const step = (seconds) => move(Math.min(Math.max(state.time + seconds, state.span[0]), state.span[1]), 0);
const focus = (name) => { byId(name).scrollIntoView({ block: "nearest" }); byId(name).focus(); };
setUpKeys(byId("keys"), byId("help"), [
  [" ", "pause or play", () => byId("play").click()],
  ["ArrowLeft", "1 s back, with shift 10 s", (event) => step(event.shiftKey ? -10 : -1)],
  ["ArrowRight", "1 s forward, with shift 10 s", (event) => step(event.shiftKey ? 10 : 1)],
  ["l", "live", () => byId("live").click()],
  ["c", "choose a command", () => focus("which")],
  ["p", "add a plot", () => focus("add")],
  ["z", "reset the zoom of the plots", () => byId("unzoom").click()],
  ["/", "filter the events", () => focus("filter")],
  ["t", "light or dark theme", () => byId("theme").click()],
]);

// A moment of a flight as an address: #at=123.4 shows it, paused.
function moment() {
  const at = Number(new URLSearchParams(location.hash.slice(1)).get("at") ?? NaN);
  if (Number.isFinite(at)) move(at, 0);
}
window.addEventListener("hashchange", moment);

history.replaceState(null, "", `/${location.hash}`); // the token has been used, so a copy of the address would not open the page
connect();
setInterval(light, 250);
plots.begin();
