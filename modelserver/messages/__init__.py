"""Values of the messages: samples, requests, replies, reports; inputs and outputs of the core.

Units, frames and signs are those of the wire types in `lcmtypes/`, which declare most of them; `make types` writes the
module `generated`. A number that is not known is nan, a vector or matrix None. What is exchanged with every query is a
NamedTuple, which costs a third of a dataclass; the rest are frozen dataclasses. Each public name of the modules is one
of this package.
"""

from modelserver.messages.events import *
from modelserver.messages.values import *
