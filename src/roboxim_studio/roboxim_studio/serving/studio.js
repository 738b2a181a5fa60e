// The studio's own part of the page: held keys, gamepads, single-key commands, and the line at the bottom.
// viser's page has no key-up events and no gamepads, so they go through a channel of their own.
"use strict";
(() => {
  const base = window.location.href.split("?")[0].replace(/\/?(index\.html)?$/, "");
  const held = new Set();
  const state = { driving: false, hint: "", alert: "" };
  let socket = null;
  let wait = 250;
  let lastSent = "";
  let opened = 0;

  const line = document.createElement("div");
  line.id = "studio-line";
  line.setAttribute("role", "status");
  Object.assign(line.style, {
    position: "fixed", left: "8px", bottom: "8px", maxWidth: "min(70ch, calc(100vw - 16px))", zIndex: 400,
    padding: "6px 10px", borderRadius: "6px", font: "13px/1.4 system-ui, sans-serif", whiteSpace: "pre-line",
    background: "rgba(20, 22, 26, 0.86)", color: "#fff", pointerEvents: "none", display: "none",
    boxSizing: "border-box", overflowWrap: "anywhere",
  });

  function show() {
    const narrow = window.innerWidth < 700;  // there the panel lies at the bottom
    line.style.bottom = narrow ? "" : "8px";
    line.style.top = narrow ? "8px" : "";
    const away = !socket || socket.readyState !== WebSocket.OPEN;
    const keys = state.driving && held.size ? `\nheld: ${[...held].map((code) => code.replace(/^Key/, "")).join(" ")}` : "";
    const text = away ? "The studio does not answer; trying again. Nothing is lost." : [state.alert, narrow && !state.driving ? "" : state.hint, mouseSays].filter(Boolean).join("\n") + keys;
    line.textContent = text;
    line.style.display = text ? "block" : "none";
    line.style.outline = away || state.alert ? "2px solid #ffb000" : state.driving ? "2px solid #40c057" : "none";
    document.documentElement.dataset.studioDriving = String(state.driving);
    document.documentElement.dataset.studioConnected = String(!away);
    document.documentElement.dataset.studioOpened = String(opened);
  }

  function send(message) {
    if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
  }

  function connect() {
    socket = new WebSocket(`${base.replace(/^http/, "ws")}/control`);
    socket.onopen = () => { opened += 1; wait = 250; lastSent = ""; show(); };
    socket.onmessage = (event) => {
      Object.assign(state, JSON.parse(event.data));
      if (!state.driving) release();
      show();
    };
    socket.onclose = () => { release(); show(); setTimeout(connect, wait); wait = Math.min(2 * wait, 4000); };
  }

  function typing(target) {
    return target instanceof Element && target.closest("input:not([type=range]):not([type=checkbox]), textarea, select, [contenteditable]");
  }

  function release() {
    if (held.size) { held.clear(); report(); }
  }

  function gamepad() {
    const pads = navigator.getGamepads ? [...navigator.getGamepads()].filter(Boolean) : [];
    const pad = pads.find((one) => one.mapping === "standard") || pads[0];
    if (!pad) return null;
    return { axes: pad.axes.map((value) => Math.round(value * 1000) / 1000), buttons: pad.buttons.map((one) => Math.round(one.value * 100) / 100) };
  }

  // A SpaceMouse by WebHID: its newest report of each number, as bytes; the studio reads them (space_mouse.py).
  const reports = {};
  let mouse = null;
  let mouseSays = "";
  const MICE = [0x256f, 0x046d].map((vendorId) => ({ vendorId, usagePage: 1, usage: 8 }));  // multi-axis controllers

  async function listen(device) {
    if (!device || device === mouse) return;
    try {
      if (!device.opened) await device.open();
      mouse = device;
      mouseSays = `SpaceMouse: ${device.productName}`;
      device.addEventListener("inputreport", (event) => {
        if (document.hidden) return;
        reports[event.reportId] = [...new Uint8Array(event.data.buffer, event.data.byteOffset, event.data.byteLength)];
      });
    } catch (error) {
      mouseSays = `The SpaceMouse cannot be opened (${error.message}). On Linux a udev rule must let you read it; see docs/how-to/studio.md.`;
    }
    show();
  }

  async function askForMouse() {
    if (!navigator.hid) {
      mouseSays = "This browser has no WebHID: use Chromium, Chrome or Edge at 127.0.0.1 or localhost.";
    } else {
      try {
        const [device] = await navigator.hid.requestDevice({ filters: MICE });
        mouseSays = device ? "" : "no SpaceMouse was chosen";
        await listen(device);
      } catch (error) { mouseSays = `WebHID: ${error.message}`; }
    }
    show();
  }

  function leaveMouse() {
    for (const number of Object.keys(reports)) delete reports[number];
  }

  document.addEventListener("click", (event) => {
    const button = event.target instanceof Element && event.target.closest("button");
    if (button && button.innerText.trim() === "Connect a SpaceMouse") askForMouse();
  }, true);
  if (navigator.hid) {
    const known = (device) => MICE.some((one) => one.vendorId === device.vendorId);
    navigator.hid.getDevices().then((devices) => listen(devices.find(known)), () => {});  // chosen before
    navigator.hid.addEventListener("connect", (event) => { if (known(event.device)) listen(event.device); });
    navigator.hid.addEventListener("disconnect", (event) => {
      if (event.device !== mouse) return;
      mouse = null;
      mouseSays = "the SpaceMouse is gone";
      leaveMouse();
      show();
    });
  }

  function report() {
    const pad = state.driving ? gamepad() : null;
    const message = { held: [...held].sort(), pad };
    if (state.driving && mouse) message.hid = reports;
    const text = JSON.stringify(message);
    if (text === lastSent && !state.driving) return;
    lastSent = text;
    send(message);
  }

  window.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || typing(event.target)) return;
    if (state.driving || ["Space", "Comma", "Period"].includes(event.code)) {
      event.preventDefault();
      event.stopImmediatePropagation();
    }
    if (event.repeat && state.driving) return;
    if (state.driving) { held.add(event.code); report(); show(); }
    if (!event.repeat || ["Comma", "Period"].includes(event.code)) send({ key: event.code });
  }, true);

  window.addEventListener("keyup", (event) => {
    if (held.delete(event.code)) { event.stopImmediatePropagation(); report(); show(); }
  }, true);

  // An old or software WebGL can lose the picture; nothing else tells the person.
  document.addEventListener("webglcontextlost", () => {
    state.alert = "The browser has lost its 3D picture. Reload the page: nothing is lost.";
    show();
  }, true);
  const hide = setInterval(() => {  // viser's notice on software WebGL covers a corner until it is closed
    const note = [...document.querySelectorAll(".mantine-Notification-root")].find((one) => one.innerText.includes("Software WebGL"));
    if (note) { clearInterval(hide); setTimeout(() => note.querySelector("button")?.click(), 8000); }
  }, 1000);
  setTimeout(() => clearInterval(hide), 30000);

  window.addEventListener("resize", show);
  window.addEventListener("blur", release);
  document.addEventListener("visibilitychange", () => { if (document.hidden) { leaveMouse(); release(); } });
  setInterval(() => { if (state.driving) report(); }, 50);

  document.title = "RoboXim studio";
  const style = document.createElement("style");  // viser's panel has a fixed width, also where that leaves no view
  style.textContent = '@media (max-width: 700px) { [style*="20em"] { width: 100% !important; left: 0 !important; } }';
  document.head.appendChild(style);
  const start = () => { document.body.appendChild(line); show(); connect(); };
  if (document.body) start(); else document.addEventListener("DOMContentLoaded", start);
})();
