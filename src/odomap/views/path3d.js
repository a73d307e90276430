"use strict";
// A path in three dimensions on a plain canvas: drag turns, shift-drag moves, the wheel zooms.
(() => {
  const canvas = document.getElementById("path3d");
  const source = document.getElementById("path3d-data");
  if (!canvas || !source) return;
  const data = JSON.parse(source.textContent);
  const ctx = canvas.getContext("2d");
  const slider = document.getElementById("path3d-time");
  const clock = document.getElementById("path3d-clock");
  const play = document.getElementById("path3d-play");

  const floats = (text) => {
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    return new Float32Array(bytes.buffer);
  };
  // All arrays come as x, y, z with z up.
  const path = floats(data.path), truth = floats(data.truth), points = floats(data.points);
  const loops = floats(data.loops);
  const forward = floats(data.forward), times = floats(data.times), colours = data.colours;
  const count = path.length / 3;

  const centre = [0, 0, 0];
  let radius = 1;
  const bounds = () => {
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (const array of [path, truth])
      for (let i = 0; i < array.length; i++) {
        low[i % 3] = Math.min(low[i % 3], array[i]);
        high[i % 3] = Math.max(high[i % 3], array[i]);
      }
    for (let k = 0; k < 3; k++) centre[k] = (low[k] + high[k]) / 2;
    radius = Math.max(Math.hypot(high[0] - low[0], high[1] - low[1], high[2] - low[2]) / 2, 1e-3);
    const floor = low[2] - 0.12 * radius;
    // Step back far enough to see most landmarks, but never so far that the path is a dot.
    const away = [];
    for (let i = 0; i < points.length; i += 3)
      away.push(Math.hypot(points[i] - centre[0], points[i + 1] - centre[1], points[i + 2] - centre[2]));
    away.sort((a, b) => a - b);
    if (away.length) radius = Math.max(radius, Math.min(0.8 * away[Math.floor(0.8 * away.length)], 2.5 * radius));
    return floor;
  };
  const floor = bounds();

  let yaw, pitch, zoom, panX, panY;
  const reset = () => { yaw = -0.9; pitch = 0.6; zoom = 1; panX = 0; panY = 0; };
  reset();

  let width = 0, height = 0, palette = {};
  const names = ["ink", "muted", "grid", "estimate", "truth", "keyframe", "good", "lost", "loop"];
  const colour = () => {
    const style = getComputedStyle(document.documentElement);
    for (const name of names) palette[name] = style.getPropertyValue("--" + name).trim();
  };

  let cy, sy, cp, sp, scale;
  const project = (x, y, z) => {
    x -= centre[0]; y -= centre[1]; z -= centre[2];
    const right = cy * x + sy * y, away = -sy * x + cy * y;
    const up = cp * z + sp * away, depth = cp * away - sp * z;
    const f = scale / (1 + 0.22 * Math.max(depth / radius, -3));
    return [width / 2 + panX + f * right, height / 2 + panY - 14 - f * up];
  };
  const line = (array, from, to) => {
    ctx.beginPath();
    for (let i = from; i <= to; i++) {
      const [u, v] = project(array[3 * i], array[3 * i + 1], array[3 * i + 2]);
      i === from ? ctx.moveTo(u, v) : ctx.lineTo(u, v);
    }
    ctx.stroke();
  };

  const step = (() => {
    const raw = radius / 3, power = 10 ** Math.floor(Math.log10(raw));
    return power * [1, 2, 5, 10].find((k) => k * power >= raw);
  })();
  const drawFloor = () => {
    const half = Math.ceil(1.3 * radius / step) * step;
    const x0 = Math.round(centre[0] / step) * step, y0 = Math.round(centre[1] / step) * step;
    ctx.strokeStyle = palette.grid; ctx.lineWidth = 1;
    for (let d = -half; d <= half + step / 2; d += step)
      for (const ends of [[x0 + d, y0 - half, x0 + d, y0 + half], [x0 - half, y0 + d, x0 + half, y0 + d]]) {
        ctx.beginPath();
        ctx.moveTo(...project(ends[0], ends[1], floor));
        ctx.lineTo(...project(ends[2], ends[3], floor));
        ctx.stroke();
      }
  };
  const drawPoints = () => {
    ctx.fillStyle = palette.muted;
    ctx.globalAlpha = 0.55;
    for (let i = 0; i < points.length; i += 3) {
      const [u, v] = project(points[i], points[i + 1], points[i + 2]);
      ctx.fillRect(u, v, 1.5, 1.5);
    }
    ctx.globalAlpha = 1;
  };
  const drawPath = () => {
    ctx.lineJoin = ctx.lineCap = "round";
    if (truth.length) {
      ctx.strokeStyle = palette.truth; ctx.lineWidth = 4; ctx.globalAlpha = 0.7;
      line(truth, 0, truth.length / 3 - 1);
      ctx.globalAlpha = 1;
    }
    ctx.lineWidth = 2;
    if (!colours.length) {
      ctx.strokeStyle = palette.estimate;
      for (const [from, to] of data.pieces) line(path, from, to);
    } else
      for (const [from, to] of data.pieces)
        for (let i = from; i < to; i++) { ctx.strokeStyle = colours[i + 1]; line(path, i, i + 1); }
    const fine = Math.min(1, Math.max(0.2, Math.sqrt(12 * 6 / Math.max(loops.length, 1))));
    ctx.strokeStyle = palette.loop; ctx.lineWidth = Math.max(2.5 * fine, 0.8); ctx.globalAlpha = fine;
    for (let i = 0; i < loops.length / 3; i += 2) line(loops, i, i + 1);
    ctx.globalAlpha = 1;
    ctx.fillStyle = palette.keyframe;
    for (const i of data.keyframes) {
      const [u, v] = project(path[3 * i], path[3 * i + 1], path[3 * i + 2]);
      ctx.beginPath(); ctx.arc(u, v, 1.9, 0, 7); ctx.fill();
    }
  };
  const drawBody = () => {
    const i = Math.min(+slider.value, count - 1), p = path.subarray(3 * i, 3 * i + 3);
    const reach = 0.16 * radius / Math.sqrt(zoom);
    const tip = [0, 1, 2].map((k) => p[k] + reach * forward[3 * i + k]);
    const [u, v] = project(...p), [a, b] = project(...tip);
    ctx.strokeStyle = palette.ink; ctx.lineWidth = 2.5;
    ctx.beginPath(); ctx.moveTo(u, v); ctx.lineTo(a, b); ctx.stroke();
    ctx.fillStyle = palette.ink;
    ctx.beginPath(); ctx.arc(u, v, 5, 0, 7); ctx.fill();
    clock.textContent = times[i].toFixed(2) + " s";
  };
  const drawWords = () => {
    ctx.font = "12px system-ui, sans-serif"; ctx.fillStyle = palette.muted;
    ctx.fillText("grid " + +step.toPrecision(3) + " " + data.unit, 12, 22);
    const at = [52, 66], size = 26;
    const o = [width / 2 + panX, height / 2 + panY - 14];
    [[1, 0, 0], [0, 1, 0], [0, 0, 1]].forEach((axis, k) => {
      const right = cy * axis[0] + sy * axis[1], away = -sy * axis[0] + cy * axis[1];
      const u = at[0] + size * right, v = at[1] - size * (cp * axis[2] + sp * away);
      ctx.strokeStyle = palette.muted; ctx.lineWidth = 1.2;
      ctx.beginPath(); ctx.moveTo(...at); ctx.lineTo(u, v); ctx.stroke();
      ctx.fillText(data.axes[k], u + 3, v - 2);
    });
  };

  let asked = false;
  const draw = () => {
    asked = false;
    const ratio = window.devicePixelRatio || 1;
    width = canvas.clientWidth; height = canvas.clientHeight;
    canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio);
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    cy = Math.cos(yaw); sy = Math.sin(yaw); cp = Math.cos(pitch); sp = Math.sin(pitch);
    scale = 0.43 * Math.min(width * 0.8, height - 60) / radius * zoom;
    drawFloor(); drawPoints(); drawPath(); drawBody(); drawWords();
  };
  const ask = () => { if (!asked) { asked = true; requestAnimationFrame(draw); } };

  const pointers = new Map();
  canvas.addEventListener("pointerdown", (e) => {
    canvas.setPointerCapture(e.pointerId);
    pointers.set(e.pointerId, [e.clientX, e.clientY]);
  });
  const lift = (e) => pointers.delete(e.pointerId);
  canvas.addEventListener("pointerup", lift);
  canvas.addEventListener("pointercancel", lift);
  canvas.addEventListener("pointermove", (e) => {
    const before = pointers.get(e.pointerId);
    if (!before) return;
    const dx = e.clientX - before[0], dy = e.clientY - before[1];
    if (pointers.size === 2) {
      const [other] = [...pointers].filter(([id]) => id !== e.pointerId).map(([, p]) => p);
      const was = Math.hypot(before[0] - other[0], before[1] - other[1]);
      const now = Math.hypot(e.clientX - other[0], e.clientY - other[1]);
      zoom *= now / Math.max(was, 1); panX += dx / 2; panY += dy / 2;
    } else if (e.shiftKey || e.buttons === 2) { panX += dx; panY += dy; }
    else { yaw -= dx * 0.008; pitch = Math.max(-1.57, Math.min(1.57, pitch + dy * 0.008)); }
    pointers.set(e.pointerId, [e.clientX, e.clientY]);
    ask();
  });
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("wheel", (e) => {
    e.preventDefault();
    zoom = Math.max(0.2, Math.min(60, zoom * Math.exp(-e.deltaY * 0.0015)));
    ask();
  }, { passive: false });
  canvas.addEventListener("dblclick", () => { reset(); ask(); });
  canvas.addEventListener("keydown", (e) => {
    const turn = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[e.key];
    if (turn) { yaw += turn[0]; pitch = Math.max(-1.57, Math.min(1.57, pitch + turn[1])); }
    else if (e.key === "+" || e.key === "=") zoom *= 1.2;
    else if (e.key === "-") zoom /= 1.2;
    else if (e.key === "0") reset();
    else return;
    e.preventDefault(); ask();
  });

  slider.max = count - 1;
  slider.addEventListener("input", ask);
  let timer = 0;
  play.addEventListener("click", () => {
    if (timer) { clearInterval(timer); timer = 0; play.textContent = "Play"; return; }
    if (+slider.value >= count - 1) slider.value = 0;
    play.textContent = "Pause";
    timer = setInterval(() => {
      slider.value = +slider.value + Math.max(1, Math.round(count / 300));
      if (+slider.value >= count - 1) play.click();
      ask();
    }, 33);
  });
  const scheme = matchMedia("(prefers-color-scheme: dark)");
  scheme.addEventListener("change", () => { colour(); ask(); });
  addEventListener("beforeprint", () => { colour(); draw(); });
  new ResizeObserver(ask).observe(canvas);
  colour(); ask();
})();
