"""The numbers of the decision, all fifteen. Their sensitivity is not measured yet."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Law:
    """Everything that a verdict depends on besides the data, the model and the effects' own physics.

    Shares of torque are root mean square over nominal joint torque.
    """

    #: Time between independent errors [s]. Chosen; not measured on any arm.
    independent: float = 0.5
    #: Systematic error of the model per background column, in units of its held-out error. It, `drift` and `form` come
    #: from a trial on other simulated arms, where few values were compared.
    systematic: float = 0.4
    #: What an arm changes by itself per background column, of nominal torque.
    drift: float = 0.001
    #: What friction levels of a healthy arm change from day to day, of themselves: a few kelvin at 1 to 3 % each
    #: (Bittencourt and Gunnarsson, J. Dyn. Syst. Meas. Control 134, 2012).
    daily: float = 0.05
    #: Error of any effect's form, as a share of its own torque.
    form: float = 0.05
    #: Usual sizes of effects, of nominal torque, one as likely as another. Chosen: half a decade apart.
    sizes: tuple[float, ...] = (0.007, 0.02, 0.06, 0.2)
    #: How well the model's held-out error is known: degrees of freedom. Chosen.
    nu: float = 6.0
    #: Prior probability of no effect, of an effect outside the catalogue, and of every further effect. Chosen.
    nothing: float = 0.5
    other: float = 0.1
    further: float = 0.1
    #: Smallest torque worth a name, of nominal, root mean square in the log with most of it. Chosen.
    practical: float = 0.003
    #: Squared error of a joint over its background from which on something is there, whatever it is. Chosen.
    exceeded: float = 6.0
    #: Share of the torque beyond the background that named causes close, or they do not explain it.
    adequate: float = 0.95
    #: Probability of a class from which on it is named: a wrong name costs 1.5 times an abstention.
    sure: float = 0.6
    #: Share of the leader's probability from which on another hypothesis belongs to its class.
    rival: float = 0.1
    #: Most effects in one hypothesis.
    most: int = 3
    #: Probability of something from which on an arm is not called healthy, and the highest of any class, as some form
    #: is missing from every catalogue. Chosen: the usual level of 5 %.
    certain: float = 0.95


LAW = Law()
