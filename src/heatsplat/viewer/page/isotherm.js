// What lies above, below or between temperatures, in one colour of its own. Each kind of value has an isotherm of its own.

const MARKED = [0.1, 0.85, 0.45];  // in no colour map
const percent = (share) => share > 0 && share < 0.001 ? "less than 0.1 %" : `${(100 * share).toFixed(1)} %`;

class Isotherm {
  constructor(viewer) {
    this.viewer = viewer;
  }

  // {how, ends} of what is shown, in the unit of the colours' ends; ends that nobody gave are infinite.
  get shown() {
    return this.viewer.state.isotherms[this.viewer.rangeName] || { how: "none", ends: [] };
  }

  get ends() {
    return this.shown.how === "none" ? null : this.shown.ends;
  }

  // An end that was given stays where the other kind has one.
  choose(how) {
    const { viewer } = this, [low, high] = viewer.range, at = (share) => low + share * (high - low);
    const given = this.shown.ends.filter(Number.isFinite);
    const between = () => {
      if (given.length !== 1) return given.length ? given : [at(0.25), at(0.75)];
      return given[0] < high ? [given[0], high] : [low, given[0]];
    };
    const ends = { none: () => [], above: () => [given.at(-1) ?? at(0.75), Infinity], below: () => [-Infinity, given[0] ?? at(0.25)], between };
    viewer.state.isotherms[viewer.rangeName] = { how, ends: ends[how]() };
    viewer.request();
  }

  next() {
    const kinds = [...$("isotherm").options].map((option) => option.value);
    this.choose(kinds[(kinds.indexOf(this.shown.how) + 1) % kinds.length]);
    this.viewer.say(`isotherm: ${this.shown.how}`);
  }

  typed() {
    const { viewer } = this, log = viewer.attribute?.log, { how, ends } = this.shown;
    const [low, high] = ["isothermLow", "isothermHigh"].map((id, i) => {
      if (!Number.isFinite(ends[i])) return ends[i];
      return $(id).value === "" ? NaN : log ? Math.log10(Number($(id).value)) : Number($(id).value);
    });
    viewer.request();
    this.refused = true;  // the ends that hold are shown again
    if ([low, high].some(Number.isNaN) || (log && [low, high].some((end, i) => end !== ends[i] && !Number.isFinite(end)))) return undefined;
    if (!(low < high)) return viewer.say("The lower end of the isotherm must be below the upper one.");
    this.refused = false;
    viewer.state.isotherms[viewer.rangeName] = { how, ends: [low, high] };
    return undefined;
  }

  holds(value) {
    return this.ends !== null && value >= this.ends[0] && value <= this.ends[1];
  }

  // Of some values, 0 to 1.
  share(values) {
    return values.filter((value) => this.holds(value)).length / values.length;
  }

  // Such as "above 21 °C".
  get words() {
    const { viewer } = this, ends = this.ends.filter(Number.isFinite).map((end) => Number((viewer.attribute?.log ? 10 ** end : end).toPrecision(4)));
    return `${this.shown.how} ${ends.join(" and ")}${viewer.unit ? ` ${viewer.unit}` : ""}`;
  }

  draw() {
    const { how, ends } = this.shown, shown = (value) => this.viewer.attribute?.log ? 10 ** value : value;
    $("isotherm").value = how;
    $("isothermEnds").hidden = how === "none";
    $("isothermAnd").hidden = how !== "between";
    ["isothermLow", "isothermHigh"].forEach((id, i) => {
      $(id).hidden = !Number.isFinite(ends[i]);
      if (Number.isFinite(ends[i]) && (document.activeElement !== $(id) || this.refused)) $(id).value = Number(shown(ends[i]).toPrecision(5)).toString();
    });
    this.refused = false;
  }

  // Of the values of the picture, once it is at rest.
  count(values) {
    $("isothermNote").textContent = this.ends && values.length ? `${percent(this.share(values))} of the picture` : "";
  }
}
