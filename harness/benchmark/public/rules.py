"""The rules of public benchmarks: which samples a model may see, and what is scored. One record each, with its source.

All sets but one are scored alike: a free run over the test record, for which the model is given the inputs and the
first ``window`` outputs, and the root mean square of its error over the outputs behind them. The sets of
nonlinearbenchmark.org follow its official loader, https://github.com/MaartenSchoukens/nonlinear_benchmarks, as of
2026-06-19 (commit f9fb388): ``nonlinear_benchmarks/benchmarks.py`` holds splits and windows, ``submission_examples/``
the figures; each rule was compared with their text. Those of IdentiBench follow
https://github.com/daniel-om-weber/identibench as of 2026-03-28 (e6e133a), ``identibench/datasets/``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from harness.errors import InputError
from harness.signals import Channel, PlantSpec

OFFICIAL = "nonlinearbenchmark.org"
IDENTIBENCH = "IdentiBench"


@dataclass(frozen=True)
class Rule:
    """How one public set is to be used."""

    id: str
    title: str
    spec: PlantSpec  # Channels in the units of the published files, and the sample time [s]
    window: int  # Outputs at the start of a test record that the model may see; none of them is scored
    tests: tuple[str, ...]  # Names of the figures, one for each test record or group of records
    unit: str  # Unit of the figures
    scale: float  # Factor from the outputs' unit to it
    split: str  # Which samples are for what, in words
    # Where the data are looked for under ``$SYSID_HARNESS_DATA``, and which files
    folder: str
    files: str
    download: str  # Page to get them from
    citation: str
    loader: str | None = None  # Function of the package ``nonlinear_benchmarks``
    old_window: int | None = None
    """What the window was before, where it changed: figures published under it are another figure."""
    metric: Literal["window", "horizons"] = "window"
    """{"window", "horizons"}: Root mean square behind the window; or the sum of mean errors over horizons
    (:func:`harness.benchmark.public.scores.horizon_errors`)."""
    rules_of: str = OFFICIAL  # Whose rule it is
    note: str = ""  # What to know beside the rule

    @property
    def where(self) -> str:
        """Where to get the data, in one sentence."""
        return f"put {self.files} from {self.download} in $SYSID_HARNESS_DATA/{self.folder}"


def _spec(inputs: Sequence[tuple[str, str]], outputs: Sequence[tuple[str, str]], sample_time: float) -> PlantSpec:
    """Return channels (name, unit) and sample time [s] as a spec."""
    return PlantSpec(tuple(Channel(*one) for one in inputs), tuple(Channel(*one) for one in outputs), sample_time)


SITE = "https://www.nonlinearbenchmark.org/benchmarks/"
_VOLTS = [("u", "V")], [("y", "V")]

_OFFICIAL_RULES = (
    Rule(
        id="silverbox",
        title="Silverbox",
        spec=_spec(*_VOLTS, 2**14 / 1e7),
        window=50,
        tests=("multisine", "arrow", "arrow without extrapolation"),
        unit="mV",
        scale=1e3,
        split="rows 40650 to 127400 are multisines: the first 75 % to learn from, the rest a test; "
        "rows 100 to 40575 are the arrow, its first 32000 samples the arrow without extrapolation",
        folder="silverbox",
        files="SNLS80mV.mat",
        download=SITE + "silverbox",
        citation="T. Wigren, J. Schoukens, Three free data sets for development and benchmarking in nonlinear system "
        "identification, European Control Conference, 2013, pp. 2933-2938",
        loader="Silverbox",
    ),
    Rule(
        id="wiener-hammerstein",
        title="Wiener-Hammerstein",
        spec=_spec(*_VOLTS, 1 / 51200),
        window=50,
        tests=("test",),
        unit="mV",
        scale=1e3,
        split="of rows 5200 to 184000 the first 100000 to learn from, the other 78800 the test",
        folder="wiener_hammerstein",
        files="WienerHammerBenchMark.mat",
        download=SITE + "wiener-hammerstein",
        citation="J. Schoukens, J. Suykens, L. Ljung, Wiener-Hammerstein benchmark, 15th IFAC Symposium on System "
        "Identification, Saint-Malo, 2009",
        loader="WienerHammerBenchMark",
    ),
    Rule(
        id="cascaded-tanks",
        title="Cascaded tanks",
        spec=_spec(*_VOLTS, 4.0),
        window=50,
        tests=("test",),
        unit="V",
        scale=1.0,
        split="uEst and yEst (1024 samples) to learn from, uVal and yVal (1024) the test",
        folder="cascaded_tanks",
        files="dataBenchmark.mat or dataBenchmark.csv",
        download=SITE + "cascaded-tanks",
        citation="M. Schoukens, P. Mattsson, T. Wigren, J.-P. Noel, Cascaded tanks benchmark combining soft and hard "
        "nonlinearities, Workshop on Nonlinear System Identification Benchmarks, Brussels, 2016",
        loader="Cascaded_Tanks",
        old_window=5,
    ),
    Rule(
        id="coupled-drives",
        title="Coupled electric drives",
        spec=_spec([("u", "V")], [("y", "tick/s")], 0.02),
        window=10,
        tests=("low amplitude", "high amplitude"),
        unit="ticks/s",
        scale=1.0,
        split="of both records of the uniformly distributed input (u11, z11 and u12, z12) the first 400 samples to "
        "learn from, the other 100 the tests",
        folder="coupled_drives",
        files="DATAUNIF.MAT or DATAUNIF.csv",
        download=SITE + "coupled-electric-drives",
        citation="T. Wigren, M. Schoukens, Coupled electric drives data set and reference models, Technical report "
        "2017-024, Department of Information Technology, Uppsala University, 2017",
        loader="CED",
        old_window=4,
        note="The records of the binary input (drive.mat, DATAPRBS.MAT), which the recipes coupled-drives-1 to -3 "
        "read, are no part of this benchmark.",
    ),
    Rule(
        id="emps",
        title="EMPS",
        spec=_spec([("u", "V")], [("q", "m")], 1e-3),
        window=20,
        tests=("force pulses",),
        unit="mm",
        scale=1e3,
        split="DATA_EMPS.mat (24841 samples) to learn from, DATA_EMPS_PULSES.mat the test; vir in, qm out",
        folder="emps",
        files="DATA_EMPS.mat and DATA_EMPS_PULSES.mat",
        download=SITE + "emps",
        citation="A. Janot, M. Gautier, M. Brunot, Data set and reference models of EMPS, Workshop on Nonlinear System "
        "Identification Benchmarks, Eindhoven, 2019",
        loader="EMPS",
    ),
    Rule(
        id="parallel-wiener-hammerstein",
        title="Parallel Wiener-Hammerstein",
        spec=_spec(*_VOLTS, 1 / 78125),
        window=50,
        tests=tuple(f"amplitude {k}" for k in range(1, 6)),
        unit="mV",
        scale=1e3,
        split="uEst and yEst: 20 realisations at 5 amplitudes to learn from; uVal and yVal: one test at each; "
        "two periods of 16384 samples each",
        folder="parallel_wiener_hammerstein",
        files="ParWHData.mat",
        download=SITE + "parallel-wiener-hammerstein",
        citation="M. Schoukens, A. Marconato, R. Pintelon, G. Vandersteen, Y. Rolain, Parametric identification of "
        "parallel Wiener-Hammerstein systems, Automatica 51, 2015, pp. 111-122",
        loader="ParWH",
        note="The two periods follow each other here. The official loader reshapes (16384, 2) to 32768 samples in the "
        "order of C, so that its records take a sample of each period in turn.",
    ),
    Rule(
        id="f16",
        title="F-16 ground vibration test",
        spec=_spec([("force", "N")], [("acceleration", "m/s^2")], 1 / 400),
        window=50,
        tests=tuple(f"validation file {k}" for k in range(1, 7)),
        unit="m/s^2",
        scale=1.0,
        split="of the files without SpecialOddMSine, in the order of their names, those with Validation in it are the "
        "tests and the others to learn from; Force in, the first of three accelerations out",
        folder="f16",
        files="the folder BenchmarkData with its .mat files",
        download=SITE + "f-16-gvt",
        citation="J.-P. Noel, M. Schoukens, F-16 aircraft benchmark based on ground vibration test data, Workshop on "
        "Nonlinear System Identification Benchmarks, Brussels, 2017, pp. 19-23",
        loader="F16",
    ),
    Rule(
        id="fine-steering-mirror",
        title="Fine steering mirror",
        spec=_spec([(f"u{k}", "V") for k in (1, 2, 3)], [(f"y{k}", "m") for k in (1, 2, 3)], 1 / 6400),
        window=100,
        tests=("100 mV", "200 mV", "300 mV"),
        unit="um",
        scale=1e6,
        split="6 realisations of 2 periods of 8192 samples at each amplitude to learn from, 3 realisations the test; "
        "a figure is the mean over 3 outputs, realisations and periods",
        folder="fine_steering_mirror",
        files="combined_data.npz (or u_100mV_train.npy and its eleven neighbours)",
        download="https://github.com/merijnfloren/fsm-benchmark-data",
        citation="M. Floren, L. Peri, J. De Maeyer, W. De Munter, D. Vandepitte, J.-P. Noel, Data-driven state-space "
        "identification and nonlinearity assessment of the CubeSpec Fine Steering Mirror, ISMA-USD, 2024, "
        "pp. 2042-2052",
        loader="FineSteeringMirror",
        note="The window was 50 for a day (2026-04-09).",
    ),
    Rule(
        id="nano-drone",
        title="Nano-drone",
        spec=_spec(
            [(f"m{k}_rads", "rad/s") for k in (1, 2, 3, 4)],
            [
                *((name, "m") for name in ("x", "y", "z")),
                *((name, "m/s") for name in ("vx", "vy", "vz")),
                *((name, "1") for name in ("qx", "qy", "qz", "qw")),
                *((name, "rad/s") for name in ("wx", "wy", "wz")),
            ],
            0.01,
        ),
        window=1,
        tests=("position", "velocity", "orientation", "angular velocity"),
        unit="m, m/s, rad, rad/s",
        scale=1.0,
        split="square, random and chirp (4 runs each) to learn from, melon (3 runs) the test: from the state at every "
        "sample 50 steps ahead, mean errors summed over the steps",
        folder="nano_drone",
        files="train/ and test/ of data.zip",
        download="https://github.com/idsia-robotics/nanodrone-sysid-benchmark",
        citation="R. Busetto, E. Cereda, M. Forgione, G. Maroni, D. Piga, D. Palossi, Nonlinear system identification "
        "for a nano-drone benchmark, Control Engineering Practice, 2026 (arXiv 2512.14450)",
        loader="NanoDrone",
        metric="horizons",
        note="The loader names a window of 50 samples, which is the horizon: a prediction starts from one state.",
    ),
)


def _identibench(
    id: str, title: str, unit: str, scale: float, tests: Sequence[str], split: str, download: str, citation: str
) -> Rule:
    """Return a set of IdentiBench that this program knows the rule of and has no reader for."""
    return Rule(
        id=id,
        title=title,
        spec=_spec([("u", "1")], [("y", "1")], 1.0),
        window=100,
        tests=tuple(tests),
        unit=unit,
        scale=scale,
        split=split,
        folder=id.replace("-", "_"),
        files="what pip install identibench downloads",
        download=download,
        citation=citation,
        rules_of=IDENTIBENCH,
        note="No reader yet: the figure is for orientation.",
    )


_IDENTIBENCH_RULES = (
    Rule(
        id="noisy-wiener-hammerstein",
        title="Wiener-Hammerstein with process noise",
        spec=_spec(*_VOLTS, 1 / 78125),
        window=100,
        tests=("test",),
        unit="mV",
        scale=1e3,
        split="the realisations of WH_TestDataset (a multisine and a swept sine, without process noise) are the test, "
        "those of all other files to learn from, WH_Combined... last; a figure is the mean over both",
        folder="noisy_wiener_hammerstein",
        files="WH_TestDataset and the other files WH_..., as .mat or .csv",
        download=SITE + "wiener-hammerstein-process-noise",
        citation="M. Schoukens, J.-P. Noel, Wiener-Hammerstein benchmark with process noise, Workshop on Nonlinear "
        "System Identification Benchmarks, Brussels, 2016, pp. 15-19",
        rules_of=IDENTIBENCH,
    ),
    _identibench(
        "ship", "Patrol ship", "mixed", 1.0, ("test",),
        "propeller, two rudders and wind in, seven motions out; free run, the first 100 outputs given",
        "https://doi.org/10.18419/darus-2905", "A. Baier, S. Staab, A simulated 4-DOF ship motion dataset for system "
        "identification under environmental disturbances, DaRUS, 2022",
    ),
    _identibench(
        "quadrotor-pelican", "Quadrotor Pelican", "mixed", 1.0, ("test",),
        "four motors in, Euler rates and velocities out; free run, the first 100 outputs given",
        "https://github.com/wavelab/pelican_dataset", "N. Mohajerin, S. L. Waslander, Multistep prediction of dynamic "
        "systems with recurrent neural networks, IEEE TNNLS 30, 2019",
    ),
    _identibench(
        "quadrotor-pi", "Quadrotor PI-TCN", "mixed", 1.0, ("test",),
        "four motors in, accelerations out; free run, the first 100 outputs given",
        "https://github.com/arplaboratory/PI-TCN", "A. Saviolo, G. Li, G. Loianno, Physics-inspired temporal learning "
        "of quadrotor dynamics for accurate model predictive trajectory tracking, IEEE RA-L 7, 2022",
    ),
    _identibench(
        "industrial-robot", "Industrial robot, forward", "mixed", 1.0, ("test",),
        "six torques in, six angles out; the first 80 % of the training record to fit; free run, the first 100 outputs "
        "given", "https://fdm-fallback.uni-kl.de/TUK/FB/MV/WSKL/0001/", "J. Weigand, J. Goetz, J. Ulmen, M. Ruskowski, "
        "Dataset and baseline for an industrial robot identification benchmark, 2022",
    ),
)  # fmt: skip

RULES: dict[str, Rule] = {rule.id: rule for rule in (*_OFFICIAL_RULES, *_IDENTIBENCH_RULES)}
"""Rules by id, in the order of the table."""


def chosen_rules(names: Sequence[str] | None = None) -> tuple[Rule, ...]:
    """Return the rules of some sets, or of all.

    Raises InputError if there is no such set.

    Examples
    --------
    >>> [rule.window for rule in chosen_rules(["coupled-drives", "emps"])]
    [10, 20]
    """
    unknown = [name for name in names or () if name not in RULES]
    if unknown:
        raise InputError(
            "sets of the public table", expected=", ".join(RULES), got=", ".join(unknown), remedy="correct the name",
            place="--sets",
        )  # fmt: skip
    return tuple(rule for rule in RULES.values() if not names or rule.id in names)
