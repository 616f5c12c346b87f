// Sorts Gaussians by camera z in a worker: a stable radix sort of the bits of the floats, farthest first.

function sortingWorker() {
  let means = null, depths = null, keys = null;
  onmessage = ({ data }) => {
    if (data.means) {
      means = data.means;
      depths = new Float32Array(means.length / 3);
      keys = new Uint32Array(depths.buffer);
      return;
    }
    const start = performance.now(), [fx, fy, fz, offset] = data.forward;
    const { near, far } = data;
    const count = depths.length;
    let seen = 0, from = new Uint32Array(count), into = new Uint32Array(count);
    for (let i = 0; i < count; i++) {
      const z = fx * means[3 * i] + fy * means[3 * i + 1] + fz * means[3 * i + 2] + offset;
      depths[i] = z;
      if (z > 0 && z >= near && z <= far) from[seen++] = i;
    }
    for (const shift of [0, 16]) {
      const starts = new Uint32Array(65537);
      for (let j = 0; j < seen; j++) starts[(keys[from[j]] >>> shift & 65535) + 1]++;
      for (let k = 0; k < 65536; k++) starts[k + 1] += starts[k];
      for (let j = 0; j < seen; j++) into[starts[keys[from[j]] >>> shift & 65535]++] = from[j];
      [from, into] = [into, from];
    }
    const order = from.slice(0, seen).reverse();
    postMessage({ order, milliseconds: performance.now() - start }, [order.buffer]);
  };
}

class Sorter {
  constructor(splats, done) {
    const source = URL.createObjectURL(new Blob([`(${sortingWorker})()`], { type: "text/javascript" }));
    this.worker = new Worker(source);
    this.worker.onmessage = ({ data }) => {
      this.busy = false;
      this.milliseconds = data.milliseconds;  // that the last order took
      done(data.order);
      if (this.waiting) this.sort(...this.waiting);
    };
    this.worker.postMessage({ means: splats.means });
    this.busy = false;
    this.waiting = null;
    this.renderer = splats.told.renderer;
  }

  // Sorts for a camera; while it does, only the latest wish waits.
  sort(camera) {
    if (this.busy) {
      this.waiting = [camera];
      return;
    }
    this.waiting = null;
    this.busy = true;
    const { near, far } = this.renderer;
    this.worker.postMessage({ forward: [...camera.forward, -dot(camera.forward, camera.centre)], near, far });
  }

  stop() {
    this.worker.terminate();
  }
}
