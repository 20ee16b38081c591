// Settings of the scope, stored by this browser.

const KEPT = "rtloop-scope";

const fresh = (axis) => ({
  signals: [`${axis}_position_um`, `${axis}_reference_um`, `${axis}_drive_v`],
  seconds: 0.2,
  stacked: false,
  autoscale: true,
  overlay: 0,
  suited: true,
  trigger: {
    mode: "auto", kind: "step", source: `${axis}_reference_um`, level: 0, slope: "rising", hysteresis: 0,
    low: -1, high: 1, threshold: 0.1, holdoff_s: 0, pre_percent: 20,
  },
});

/** As it was left here, or the defaults where that does not suit the loop of `panel`. */
export function remembered(panel) {
  const first = fresh(panel.axes[0]);
  const known = (name) => panel.columns.some((column) => column.name === name);
  try {
    const kept = JSON.parse(localStorage.getItem(KEPT)) ?? {};
    const view = { ...first, ...kept, trigger: { ...first.trigger, ...kept.trigger } };
    return view.signals.length && view.signals.every(known) && known(view.trigger.source) ? view : first;
  } catch {
    return first;
  }
}

export const remember = (view) => localStorage.setItem(KEPT, JSON.stringify(view));
