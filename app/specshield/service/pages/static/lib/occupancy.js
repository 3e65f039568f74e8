// The cells of a map, from its picture: what is free, and how far it is to a place. Metres, map frame.

const MOST = 300; // cells along a side of the grid that distances are computed on

export class Occupancy {
  /** map: as the API shows it. bitmap: its image.png, white where it is free. */
  constructor(map, bitmap) {
    this.map = map;
    const canvas = Object.assign(document.createElement("canvas"), { width: map.width, height: map.height });
    const pen = canvas.getContext("2d", { willReadFrequently: true });
    pen.drawImage(bitmap, 0, 0);
    const { data } = pen.getImageData(0, 0, map.width, map.height);
    this.occupied = new Uint8Array(map.width * map.height); // row 0 is the highest y
    for (let i = 0; i < this.occupied.length; i++) this.occupied[i] = data[4 * i] < 128 ? 1 : 0;
  }

  /** The same but for some cells. occupied, free: row * width + column, where row 0 is the lowest. */
  changed(occupied, free) {
    const other = Object.assign(Object.create(Occupancy.prototype), this, { occupied: this.occupied.slice() });
    const { width, height } = this.map;
    const at = (cell) => (height - 1 - Math.floor(cell / width)) * width + (cell % width);
    for (const cell of occupied) other.occupied[at(cell)] = 1;
    for (const cell of free) other.occupied[at(cell)] = 0;
    return other;
  }

  /** [column, row] of a point; they may lie outside. */
  cell([x, y]) {
    const { origin, resolution, height } = this.map;
    const [dx, dy] = [x - origin[0], y - origin[1]];
    const [c, s] = [Math.cos(origin[2]), Math.sin(origin[2])];
    return [
      Math.floor((c * dx + s * dy) / resolution),
      height - 1 - Math.floor((c * dy - s * dx) / resolution),
    ];
  }

  blocked(point) {
    const [column, row] = this.cell(point);
    const { width, height } = this.map;
    return column < 0 || row < 0 || column >= width || row >= height || this.occupied[row * width + column] === 1;
  }

  /** Whether a disc fits here, as far as its edge and centre tell: for drawing and for stand-in robots. */
  fits([x, y], radius) {
    if (this.blocked([x, y])) return false;
    for (let i = 0; i < 16; i++) {
      const angle = (i * Math.PI) / 8;
      if (this.blocked([x + radius * Math.cos(angle), y + radius * Math.sin(angle)])) return false;
    }
    return true;
  }

  /** A picture of the walls alone, as an address for <image>. */
  walls() {
    const { width, height } = this.map;
    const canvas = Object.assign(document.createElement("canvas"), { width, height });
    const pen = canvas.getContext("2d");
    const image = pen.createImageData(width, height);
    const words = new Uint32Array(image.data.buffer);
    for (let i = 0; i < words.length; i++) words[i] = this.occupied[i] ? 0xff40_3834 : 0;
    pen.putImageData(image, 0, 0);
    return new Promise((done) => canvas.toBlob((blob) => done(URL.createObjectURL(blob))));
  }

  /** A function from points to metres along free space to `goal`, for a disc of this radius. */
  distances(goal, radius) {
    const { bounds, resolution } = this.map;
    const [wide, high] = [bounds[2] - bounds[0], bounds[3] - bounds[1]];
    const side = Math.max(resolution, Math.max(wide, high) / MOST);
    const [columns, rows] = [Math.ceil(wide / side), Math.ceil(high / side)];
    const place = ([x, y]) => [Math.floor((x - bounds[0]) / side), Math.floor((y - bounds[1]) / side)];
    const found = new Float64Array(columns * rows).fill(Infinity);
    const free = new Uint8Array(columns * rows);
    for (let j = 0; j < rows; j++)
      for (let i = 0; i < columns; i++)
        free[j * columns + i] = this.fits([bounds[0] + (i + 0.5) * side, bounds[1] + (j + 0.5) * side], radius);
    const [gi, gj] = place(goal);
    if (gi < 0 || gj < 0 || gi >= columns || gj >= rows) return () => Infinity;
    found[gj * columns + gi] = 0;
    for (let queue = [[gi, gj]]; queue.length; ) {
      const next = [];
      for (const [i, j] of queue) {
        const here = found[j * columns + i];
        for (const [di, dj, far] of STEPS) {
          const [ni, nj] = [i + di, j + dj];
          const k = nj * columns + ni;
          if (ni < 0 || nj < 0 || ni >= columns || nj >= rows || !free[k] || found[k] <= here + far) continue;
          found[k] = here + far;
          next.push([ni, nj]);
        }
      }
      queue = next;
    }
    return (point) => {
      const [i, j] = place(point);
      return i < 0 || j < 0 || i >= columns || j >= rows ? Infinity : found[j * columns + i] * side;
    };
  }
}

const STEPS = [-1, 0, 1].flatMap((di) =>
  [-1, 0, 1].filter((dj) => di || dj).map((dj) => [di, dj, Math.hypot(di, dj)]),
);
