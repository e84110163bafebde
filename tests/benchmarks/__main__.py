"""``python -m tests.benchmarks [section ...] [--quick] [--scene TEXT]`` prints tables; the whole run writes a page in docs.

Sections: kernels (ns per evaluation against C), models (the same for every model, and what it takes to compile all), targets
(the maps that gonio promises), accuracy (run time against error, gonio and its peers), size (cost against the size of the
map), start (of the command line), band (of a posterior), rig (the simulator: motion of a scan, a frame), bus (a cycle on the
servos' line against its bytes alone), fit (effective draws per second, gonio's against a user's script and NUTS).
"""

from __future__ import annotations

import argparse
import time

from tests.benchmarks import accuracy, band, bus, fit, kernels, models, page, rig, size, start, targets

SECTIONS = ("kernels", "models", "targets", "accuracy", "size", "start", "band", "rig", "bus", "fit")
INTRODUCTION = """# Benchmarks

What a reflectance map costs, beside what it costs a user who picks something else.

    make bench                                              # all sections, more than an hour
    .venv/bin/python -m tests.benchmarks targets --write    # one of them, written into this page

Nothing here is a test: times depend on the machine and on what else it does. Each section says when it was run.
"""
ACCURACY = """
Wall time per map of 64 x 64 gradients in [-3, 3] and, after the dot, evaluations of f_r per gradient, for the *true* error
in the head of the column: the largest relative error over 20 of the pixels, among them those that mirror the sun and those
that its terminator crosses. Truths are from `tests/independent.py`, which shares no code with gonio (its error is 1e-11),
and for the bilinear map from a rule on each texel (1e-10; oren_nayar 1e-8). Pixels fainter than 1e-6 of the brightest do not
count. `-`: not reached, or only in more time than was given. `~`: timed on the sample and scaled.

gonio computes the whole map, on all cores. The peers compute on one core: product rules and Mitsuba those 20 pixels, scipy
eight of them, timed on the six that were drawn at random. Their processor times are scaled to the whole map and divided by
the number of cores, as if they scaled perfectly. "split": the user has worked out by hand where the sky's and the surface's
horizons cut, or has put coordinates on the disk. "numpy, Gauss on the disk" is a script that knows that the source is a disk
and nothing else.

Surfaces: lambert of albedo 0.8; oren_nayar of 20 degrees; phong of exponent 50; ggx alpha with f_0 = 0.04 over lambert 0.5.
Sources: sphere (uniform), sky (hemispherical), overcast (CIE), disks of half angle 5 and 0.25 degrees at 40 degrees, vmf
(0.2 and four von Mises-Fisher lobes, kappa 10 to 100), map (the same on 64 x 128 bilinear texels), beam (collimated; a delta
function that no quadrature sees, so its peer is the formula itself in NumPy).
"""


def main() -> None:
    """Run the sections and print, or write the page."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("section", nargs="*", choices=[*SECTIONS, []], help="all by default")
    parser.add_argument("--quick", action="store_true", help="a few scenes, a minute on an idle machine; writes no page")
    parser.add_argument("--write", action="store_true", help="put the sections that are run into the page in docs")
    parser.add_argument("--scene", default="", help="accuracy: only scenes whose name contains this")
    given = parser.parse_args()
    chosen = given.section or SECTIONS
    whole = len(chosen) == len(SECTIONS) and not given.quick and not given.scene
    began = time.perf_counter()
    machine = page.machine()
    speeds = kernels.measure()
    text: dict[str, str] = {}

    def tell(section: str, body: str) -> None:
        text[section] = f"\n## {page.TITLES[section]}\n\n*{machine}*\n\n{body}"
        print(f"{text[section]}\n({time.perf_counter() - began:.0f} s so far)", flush=True)

    tell("kernels", page.kernels(speeds))
    if "models" in chosen:
        tell("models", models.report(models.measure(), models.compile_cold()))
    found, results, costs, started = [], [], {}, None
    if "targets" in chosen:
        found = list(targets.measure(quick=given.quick))
        tell("targets", page.times(found, speeds.factor))
    if "accuracy" in chosen:
        for result in accuracy.measure(quick=given.quick, chosen=given.scene):
            results.append(result)
            print(f"\n{page.one_result(result)}({time.perf_counter() - began:.0f} s so far)", flush=True)
        body = f"![time against error]({page.PICTURE})\n{ACCURACY}\n{page.summary(results)}"
        tell("accuracy", body)
        text["accuracy"] += "\n### Scene by scene\n\n" + "\n".join(
            page.one_result(r) for r in results if r.scene in accuracy.SHOWN
        )
    if "size" in chosen:
        costs = {scene: size.measure(scene, quick=given.quick) for scene in size.SCENES}
        tell("size", page.sizes(costs))
    if "start" in chosen:
        started = start.measure(quick=given.quick)
        tell("start", page.start(started))
    if "band" in chosen:
        tell("band", page.bands([band.measure(l, quick=given.quick) for l in band.LIGHTS]))
    if "rig" in chosen:
        tell("rig", rig.report(rig.measure(quick=given.quick)))
    if "bus" in chosen:
        tell("bus", bus.report(bus.measure(quick=given.quick)))
    if "fit" in chosen:
        tell("fit", fit.report(fit.measure(quick=given.quick)))
    if started is not None and found and results:
        tell("verdicts", page.verdicts(speeds, results, found, costs, started, quick=given.quick))
    if whole:
        page.picture(results, page.DOCS / page.PICTURE)
    if (whole or given.write) and not given.quick:
        page.write_sections(INTRODUCTION, text)
        print(f"\nwrote {', '.join(text)} into {page.DOCS / 'benchmarks.md'}")


if __name__ == "__main__":
    main()
