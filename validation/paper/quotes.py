"""What the paper reports, in our words and with its place, and what it leaves open.

K. Ziaei, D. W. L. Wang, Application of orthonormal basis functions for identification of flexible-link
manipulators, Control Engineering Practice 14 (2006) 99-106. Facts and numbers only.
"""

from __future__ import annotations

from dataclasses import dataclass

SOURCE = (
    "K. Ziaei and D. W. L. Wang, Application of orthonormal basis functions for identification of "
    "flexible-link manipulators, Control Engineering Practice 14 (2006) 99-106"
)


@dataclass(frozen=True)
class Reported:
    """One figure of the paper: its title here, what the paper says of it, and where."""

    number: int
    title: str
    place: str
    says: str


REPORTED = (
    Reported(
        1,
        "Error surface of a second-order resonant system",
        "p. 103, section 3, Fig. 1",
        "The cost over (beta, gamma), beta from 0.98 to 1 and gamma from -1 to -0.9988 (Wahlberg's sign), "
        "J from 0 to 0.04. Several local minima are seen close to the global one; hence a global search, "
        "DIRECT. No number of minima, no system, no record is given.",
    ),
    Reported(
        2,
        "Simulation: Bode plot of the plant and of the GOBF model",
        "p. 104, section 4, Fig. 2",
        "1000 samples under a PRBS, white output noise of variance 0.004², signal-to-noise ratio 30 dB, "
        "order 4 (two real poles, one pair), prior knowledge ignored: the identified model matches the "
        "actual one very well. No error is given.",
    ),
    Reported(
        3,
        "Simulation: ARX, ARMAX and OE of the same order",
        "p. 104, section 4, Fig. 3",
        "Fourth-order ARX, OE and ARMAX models from MATLAB's identification toolbox: none identifies the "
        "dynamics satisfactorily, which is put down to the noise.",
    ),
    Reported(
        4,
        "Experiment: Bode plots of GOBF, ARX, ARMAX and OE",
        "p. 104-105, section 4.1, Fig. 4",
        "Link of 1 m, 6.35 mm x 6.35 mm aluminium, motor voltage to tip position, 200 Hz, PRBS, order 4: "
        "besides GOBF only OE finds the resonance, with its other poles and zeros wrong.",
    ),
    Reported(
        5,
        "Experiment: GOBF on fresh data",
        "p. 105, section 4.1, Fig. 5",
        "Six seconds of fresh data, the tip between about -0.15 and 0.2 m: GOBF describes them quite well. "
        "No fit is given.",
    ),
    Reported(
        6,
        "Experiment: ARX, ARMAX and OE on fresh data",
        "p. 105, section 4.1, Fig. 6",
        "The same cross-validation for the other three: none captures the dynamics adequately. No fit is "
        "given.",
    ),
    Reported(
        7,
        "Bounds of two standard deviations by stochastic embedding",
        "p. 105-106, section 4.1, Fig. 7",
        "The Bode plot of the GOBF model with bounds of two standard deviations (Goodwin, Gevers and "
        "Ninness 1992): the uncertainty is larger at higher frequencies. No truth to hold them against, no "
        "hyperparameters.",
    ),
)

# (what the paper does not print, what we chose)
OPEN_CHOICES = (
    (
        "system and record of Fig. 1",
        "a resonance at 28 rad/s with damping 0.002 (the middle of the window), 1000 samples at 200 Hz "
        "under a PRBS, output variance 0.04 (the top of the J axis), noise at 30 dB",
    ),
    (
        "flexible pole, gains and damping of the simulation",
        "pair at 15 rad/s with damping 0.020, zeros at +10.8 and -10.5 rad/s as printed; input held over a "
        "sample; signal-to-noise ratio as standard deviations, so the clean output has 0.1265 m",
    ),
    (
        "register, clock and amplitude of the PRBS, seeds",
        "11 bits, a new value every sample, start register from the seed of the run; every draw of input "
        "and noise is named by this seed",
    ),
    (
        "box and budget of DIRECT",
        "x and gamma from 0 and beta from -1 to almost 1 (1 - 0.2/N); 500 cost evaluations, for the "
        "paper's search of Fig. 2 ten times as many",
    ),
    (
        "starting points and options of the toolbox and of GOBF",
        "OE from ARX and from four-stage instrumental variables, ARMAX from ARX and from two-stage least "
        "squares, the better end kept; delay of one sample, no offset, from rest. GOBF as this project "
        "does by default: offset and initial state are estimated where the data ask for them. Beside these "
        "stand OE and ARMAX with a better start, from Steiglitz-McBride as well",
    ),
    (
        "hub, motor, friction and sensor of the experiment",
        "the project's paper_link: a geared motor of 0.55 N m/V on a hub of 0.03 kg m²; dry friction of "
        "0.02 N m, strain-gauge noise of 4 mm, the only noise level the paper prints",
    ),
    (
        "how the machine was moved, and whether the tip was kept from drifting",
        "open loop at ±1.5 V for 6 s, from rest, which keeps the tip within a few decimetres; the tip "
        "signal is left as it is: neither increments nor a prefilter nor an offset is taken out, for any "
        "method",
    ),
    (
        "what two standard deviations mean for a complex number",
        "the ellipse of two standard deviations in every direction of the complex plane, 86.5 % of a "
        "Gaussian; the bands of gain and phase are its extremes",
    ),
)
