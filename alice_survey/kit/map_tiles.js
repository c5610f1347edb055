/* The report's map, part 1 of 2: a picture with a pyramid of tiles. */

/* Its tiles are the page's own, or a server's. Shows the level that fits the zoom. A tile is
   decoded when it comes into view; the tiles of the level before stay until those of the next
   are there, so that the map never blinks. */
const Pyramid = leaflet.Layer.extend({
  initialize(about, pane) {
    this.about = about;
    this.level = 0;
    this._pane = pane;
    this._tiles = new Map();
    this._text = null;
  },

  onAdd() {
    this._map.on("zoomend moveend resize", this._update, this);
    this._map.on("move", this._glance, this);
    this._update();
  },

  onRemove(map) {
    map.off("zoomend moveend resize", this._update, this);
    map.off("move", this._glance, this);
    this._tiles.forEach((tile) => tile.remove());
    this._tiles.clear();
  },

  /* While the map is dragged, at most five times a second. */
  _glance() {
    if (this._waiting) return;
    this._waiting = true;
    setTimeout(() => {
      this._waiting = false;
      if (this._map) this._update();
    }, 200);
  },

  _update() {
    const {about} = this;
    const zoom = this._map.getZoom();
    const ratio = Math.min(2, window.devicePixelRatio || 1);
    const shrunk = Math.log2(1 / (about.pixel * 2 ** zoom * ratio));
    const halvings = Math.min(about.levels - 1, Math.max(0, Math.floor(shrunk + 0.25)));
    this.level = about.levels - 1 - halvings;
    const wanted = this._inView(halvings);
    wanted.forEach((bounds, name) => {
      if (this._tiles.has(name)) return;
      const tile = leaflet.imageOverlay(this._uri(name), bounds, {pane: this._pane});
      tile.pending = true;
      tile.on("load error", (event) => {
        tile.pending = false;
        if (!this._map) return;  /* the layer was put away meanwhile */
        this._drop();
        if (event.type === "error") this._map.fire("tilelost");
      });
      this._tiles.set(name, tile);
      tile.addTo(this._map);
      tile.setZIndex(Number(name.split("/")[0]) + 1);
    });
    this._wanted = wanted;
    this._drop();
    /* Beyond full resolution a pixel is a square, not a blur. */
    const crisp = halvings === 0 && shrunk < -0.01;
    this._tiles.forEach((tile) => tile.getElement().classList.toggle("crisp", crisp));
  },

  /* Name and bounds of each tile of a level that is in view, or close to it. */
  _inView(halvings) {
    const {about} = this;
    const [columns, rows, width, height] = this._size(halvings);
    const view = this._map.getBounds().pad(0.1);
    const [wide, high] = [about.tile * width, about.tile * height];
    const first = (at, side) => Math.max(0, Math.floor(at / side));
    const last = (at, side, pixels) => Math.min(Math.ceil(pixels / about.tile) - 1,
      Math.floor(at / side));
    const [left, right] = [view.getWest() - about.west, view.getEast() - about.west];
    const [above, below] = [about.north - view.getNorth(), about.north - view.getSouth()];
    const found = new Map();
    for (let x = first(left, wide); x <= last(right, wide, columns); x += 1) {
      for (let y = first(above, high); y <= last(below, high, rows); y += 1) {
        const name = this.level + "/" + x + "/" + y;
        if (about.tiles && !about.tiles[name]) continue;  /* nothing is there */
        const east = about.west + Math.min((x + 1) * about.tile, columns) * width;
        const south = about.north - Math.min((y + 1) * about.tile, rows) * height;
        found.set(name, [[south, about.west + x * wide], [about.north - y * high, east]]);
      }
    }
    return found;
  },

  /* Columns, rows and a pixel's width and height of a level. */
  _size(halvings) {
    const {about} = this;
    if (about.sizes) return about.sizes[halvings];
    const side = 2 ** halvings;
    const pixel = about.pixel * side;
    return [Math.ceil(about.width / side), Math.ceil(about.height / side), pixel, pixel];
  },

  _drop() {
    if ([...this._wanted.keys()].some((name) => this._tiles.get(name).pending)) return;
    this._tiles.forEach((tile, name) => {
      if (this._wanted.has(name)) return;
      tile.remove();
      this._tiles.delete(name);
    });
  },

  _uri(name) {
    if (this.about.address) return this.about.address.replace("{}", name);
    if (this._text === null) this._text = document.getElementById(this.about.block).textContent;
    const [at, length] = this.about.tiles[name];
    return "data:image/webp;base64," + this._text.slice(at, at + length);
  },
});
