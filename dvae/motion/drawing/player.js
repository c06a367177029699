// Skeletons on canvases: play, scrub, turn. The .controls move all .stage elements of their parent together.
// Each stage has its scenes in data-motion; see player.py for their form.
'use strict';

const MISSING = -32768, SMALLEST = 64, NAME = 17, THICK = .02;
const TURNS = {ArrowLeft: [-.26, 0], ArrowRight: [.26, 0], ArrowUp: [0, .1], ArrowDown: [0, -.1]};

const unpacked = async text => {
  const bytes = Uint8Array.from(atob(text), letter => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('deflate'));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer()), count = planes.length / 2;
  const whole = new Int16Array(count);
  for (let i = 0; i < count; i++) whole[i] = planes[i] | planes[count + i] << 8;
  return whole;
};

// Coordinates were stored as steps from the frame before; a person's first future frame follows the last observed one.
const opened = async scene => {
  const values = await unpacked(scene.packed), size = 3 * scene.joints, first = size * scene.observed;
  for (let i = size; i < first; i++) values[i] += values[i - size];
  const people = [];
  let start = first;
  for (const person of scene.people) {
    for (let i = first ? 0 : size; i < size * person.frames; i++)
      values[start + i] += values[i < size ? first - size + i : start + i - size];
    people.push({...person, start});
    start += size * person.frames;
  }
  const at = (person, frame) => frame < scene.observed ? frame * size
    : person.start + Math.min(frame - scene.observed, person.frames - 1) * size;
  return {...scene, people, values, at};
};

const play = async controls => {
  const [button, select, slider, time] = ['button', 'select', 'input', 'output'].map(name => controls.querySelector(name));
  const stages = [...controls.parentElement.querySelectorAll('.stage')].map(canvas =>
    ({canvas, pen: canvas.getContext('2d'), scenes: JSON.parse(canvas.dataset.motion)}));
  controls.hidden = !stages.length;
  if (!stages.length) return;
  const width = () => Math.min(...stages.map(stage => stage.canvas.clientWidth));
  let scenes, view, frame, started = null, turn = 0, tilt = .2, wide = width();

  // One scale and one camera for all stages.
  const together = () => {
    const [{middle, milliseconds, observed}] = scenes, most = of => Math.max(...scenes.map(of));
    return {middle, milliseconds, observed, frames: most(scene => scene.frames), count: most(scene => scene.people.length),
      low: -most(scene => -scene.low), high: most(scene => scene.high),
      reach: most(scene => scene.reach + Math.hypot(scene.middle[0] - middle[0], scene.middle[1] - middle[1]))};
  };

  const draw = () => {
    const {count, reach, low, high, observed, milliseconds} = view;
    const [right, up] = [2 * reach, (high - low) * Math.cos(tilt) + 2 * reach * Math.abs(Math.sin(tilt))];
    const most = Math.max(240, .7 * innerHeight);
    let columns = 1, scale = 0;
    for (let tried = 1; tried <= count; tried++) {  // as large as can be, in one window of the browser
      const fits = Math.min(wide / tried / right, (most / Math.ceil(count / tried) - NAME) / up);
      if (fits > scale) [columns, scale] = [tried, fits];
    }
    if (right * scale < SMALLEST) {  // or as small as may be, and higher than it
      columns = Math.max(1, Math.min(count, Math.floor(wide / SMALLEST)));
      scale = Math.min(wide / columns / right, most / up);
    }
    stages.forEach((stage, n) => drawStage(stage, scenes[n], columns, scale, up));
    slider.value = frame;
    const seconds = (frame - Math.max(observed, 1) + 1) * milliseconds / 1000;
    time.textContent = slider.ariaValueText = `${seconds < 0 ? '−' : '+'}${Math.abs(seconds).toFixed(2)} s`;
  };

  const drawStage = ({canvas, pen}, scene, columns, scale, up) => {
    const {people, bones, values, at, unit, observed} = scene, {middle, reach, low, high} = view;
    const rows = Math.ceil(people.length / columns), [w, h] = [wide / columns, up * scale + NAME];
    const sharp = devicePixelRatio || 1, [across, down] = [wide * sharp, rows * h * sharp].map(Math.round);
    if (canvas.width !== across || canvas.height !== down) {
      Object.assign(canvas, {width: across, height: down});
      canvas.style.height = `${rows * h}px`;
    }
    pen.setTransform(sharp, 0, 0, sharp, 0, 0);
    pen.clearRect(0, 0, wide, rows * h);
    Object.assign(pen, {lineCap: 'round', lineJoin: 'round', font: '12px system-ui, sans-serif', textAlign: 'center'});

    const [c, s, ct, st] = [Math.cos(turn), Math.sin(turn), Math.cos(tilt), Math.sin(tilt)];
    const now = Math.min(frame, scene.frames - 1), before = Math.floor(now), after = Math.ceil(now);
    const share = now - before, half = (low + high) / 2;
    people.forEach((person, k) => {
      const [x0, y0] = [(k % columns + .5) * w, Math.floor(k / columns) * h + NAME + up * scale / 2];
      const seen = (x, y, z) => [x0 + scale * (c * x - s * y), y0 - scale * ((z - half) * ct + (s * x + c * y) * st)];
      const line = (...points) => points.forEach((point, i) => i ? pen.lineTo(...seen(...point)) : pen.moveTo(...seen(...point)));
      pen.strokeStyle = '#999';
      pen.lineWidth = 1;
      pen.beginPath();
      line(...[[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]].map(([x, y]) => [.6 * reach * x, .6 * reach * y, low]));
      pen.stroke();
      pen.fillStyle = '#57606a';
      pen.fillText(person.name, x0, Math.floor(k / columns) * h + NAME - 4);
      if (after >= observed + person.frames) return;  // a motion that ends early
      const [a, b] = [at(person, before), at(person, after)];
      const joint = j => {
        if (values[a + 3 * j] === MISSING || values[b + 3 * j] === MISSING) return null;
        const [x, y, z] = [0, 1, 2].map(i => unit * ((1 - share) * values[a + 3 * j + i] + share * values[b + 3 * j + i]));
        return [x - middle[0], y - middle[1], z];
      };
      const past = before < observed, alike = new Set(person.fixed);
      for (const dark of [false, true]) {  // bones that move alike in all samples are dark and thick
        pen.strokeStyle = past ? scene.past : dark ? scene.dark : person.colour;
        pen.lineWidth = Math.max(1.2, THICK * scale) * (dark ? 1.5 : 1);
        pen.beginPath();
        for (const bone of bones) {
          const ends = alike.has(bone[1]) === dark ? bone.map(joint) : [null];
          if (ends.every(Boolean)) line(...ends);
        }
        pen.stroke();
      }
    });
  };

  const stop = () => { started = null; button.textContent = 'Play'; };
  const move = now => {
    if (started === null) return;
    frame = Math.min(view.frames - 1, Math.max(0, (now - started) / view.milliseconds));
    if (frame === view.frames - 1) stop();
    draw();
    requestAnimationFrame(move);
  };
  const show = async () => {
    stop();
    scenes = await Promise.all(stages.map(stage => opened(stage.scenes[select.value])));
    view = together();
    slider.max = view.frames - 1;
    frame = view.observed ? view.frames - 1 : 0;
    draw();
    controls.dataset.frames = view.frames;
  };

  button.addEventListener('click', () => {
    if (started !== null) return stop();
    if (frame >= view.frames - 1) frame = 0;
    started = performance.now() - frame * view.milliseconds;
    button.textContent = 'Pause';
    requestAnimationFrame(move);
  });
  slider.addEventListener('input', () => { stop(); frame = +slider.value; draw(); });
  select.addEventListener('change', show);
  const turned = (across, down) => {
    turn += across;
    tilt = Math.min(1.5, Math.max(-.2, tilt + down));
    draw();
  };
  for (const {canvas} of stages) {
    let last = null;
    canvas.addEventListener('pointerdown', event => {
      canvas.setPointerCapture(event.pointerId);
      last = event;
    });
    canvas.addEventListener('pointermove', event => {
      if (!last || !event.buttons) return;
      turned((event.clientX - last.clientX) / 100, (event.clientY - last.clientY) / 200);
      last = event;
    });
    canvas.addEventListener('keydown', event => {
      if (event.key === ' ') button.click();
      else if (event.key in TURNS) turned(...TURNS[event.key]);
      else return;
      event.preventDefault();
    });
  }
  await show();
  const resized = new ResizeObserver(() => {
    if (width() === wide) return;
    wide = width();
    draw();
  });
  stages.forEach(({canvas}) => resized.observe(canvas));
};

document.querySelectorAll('.controls').forEach(controls => play(controls).catch(error => {
  controls.querySelector('output').textContent = `cannot be played here: ${error.message}`;
}));
