// Sends where a headset's controllers are, and their buttons, to the server of the Python package `teleop`.
"use strict";

const SEND_EVERY_MS = 10;
const TRIGGER = 0; // numbers of the buttons in WebXR's "xr-standard" mapping
const SQUEEZE = 1;
// The server's own fields, which it needs: with `move` false it leaves poses alone and hands the message on.
const NOTHING = {
    move: false,
    position: { x: 0, y: 0, z: 0 },
    orientation: { x: 0, y: 0, z: 0, w: 1 },
};

let socket;

function show(id, words) {
    document.getElementById(id).textContent = words;
}

function connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    socket = new WebSocket(`${scheme}://${location.host}/ws`);
    socket.onopen = () => show("connection", "Connected.");
    socket.onclose = () => {
        show("connection", "Not connected; trying again ...");
        setTimeout(connect, 1000);
    };
}

// Null where tracking is lost: a position that the headset only guesses is none.
function handOf(source, frame, space) {
    const pose = frame.getPose(source.gripSpace, space);
    if (!pose || pose.emulatedPosition) return null;
    const { position: p, orientation: q } = pose.transform;
    const pressed = (button) => Boolean(source.gamepad.buttons[button]?.pressed);
    return {
        position: { x: p.x, y: p.y, z: p.z },
        orientation: { x: q.x, y: q.y, z: q.z, w: q.w },
        squeeze: pressed(SQUEEZE),
        trigger: pressed(TRIGGER),
    };
}

function handsOf(session, frame, space) {
    const hands = {};
    for (const source of session.inputSources) {
        if (!source.gripSpace || !source.gamepad) continue;
        const hand = handOf(source, frame, space);
        if (hand) hands[source.handedness] = hand;
    }
    return hands;
}

function send(hands) {
    if (socket.readyState !== WebSocket.OPEN) return;
    socket.send(JSON.stringify({ type: "pose", data: { ...NOTHING, hands } }));
}

async function start() {
    const inRoom = await navigator.xr.isSessionSupported("immersive-ar");
    const session = await navigator.xr.requestSession(inRoom ? "immersive-ar" : "immersive-vr", {
        requiredFeatures: ["local-floor"],
    });
    session.addEventListener("end", () => show("session", "Ended."));
    const gl = document.createElement("canvas").getContext("webgl", { xrCompatible: true });
    session.updateRenderState({ baseLayer: new XRWebGLLayer(session, gl) });
    const space = await session.requestReferenceSpace("local-floor");
    let sent = 0;
    const onFrame = (time, frame) => {
        session.requestAnimationFrame(onFrame);
        if (time - sent < SEND_EVERY_MS) return;
        sent = time;
        const hands = handsOf(session, frame, space);
        send(hands);
        show("session", `Controllers: ${Object.keys(hands).sort().join(" and ") || "none"}`);
    };
    session.requestAnimationFrame(onFrame);
}

document.getElementById("start").addEventListener("click", () => {
    if (!navigator.xr) {
        show("session", "This browser has no WebXR: open the page in the headset's, by https.");
        return;
    }
    start().catch((error) => show("session", `The session did not start: ${error.message}`));
});
connect();
