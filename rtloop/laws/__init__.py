"""Laws as plug-ins: the contract, the shipped ones, and how one becomes what the loop calls."""

from rtloop.laws.contract import Controller, CoupledController, Feedforward
from rtloop.laws.options import ControllerOptions, FeedforwardOptions

__all__ = ["Controller", "ControllerOptions", "CoupledController", "Feedforward", "FeedforwardOptions"]
