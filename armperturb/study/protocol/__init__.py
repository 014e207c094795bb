"""What is run: conditions, pulses and trials of an experiment, as data (thesis 2.5, table 2.1)."""

from armperturb.study.protocol.condition import PULSE_UNIT as PULSE_UNIT
from armperturb.study.protocol.condition import Condition as Condition
from armperturb.study.protocol.condition import PlannedTrial as PlannedTrial
from armperturb.study.protocol.protocol import FORCES as FORCES
from armperturb.study.protocol.protocol import NEEDED as NEEDED
from armperturb.study.protocol.protocol import PULSE_LEAD as PULSE_LEAD
from armperturb.study.protocol.protocol import PULSE_WIDTH as PULSE_WIDTH
from armperturb.study.protocol.protocol import THESIS as THESIS
from armperturb.study.protocol.protocol import Protocol as Protocol
from armperturb.study.protocol.protocol import load_protocol as load_protocol
from armperturb.study.protocol.protocol import with_published_forces as with_published_forces
