"""Laws: their contract, the shipped laws, and the compiled functions that the loop calls.

Begin with `contract.Law`. May import hysteresis, linear, kernel and the rooms below them.
"""

from rtloop.laws.contract import Controller, CoupledController, Feedforward
from rtloop.laws.options import ControllerOptions, FeedforwardOptions

__all__ = ["Controller", "ControllerOptions", "CoupledController", "Feedforward", "FeedforwardOptions"]
