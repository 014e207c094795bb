"""What is applied: multisines, pulses, a trial made of both, and perturbations read from a file."""

from armperturb.perturbations.multisine import CLUSTERS as CLUSTERS
from armperturb.perturbations.multisine import Multisine as Multisine
from armperturb.perturbations.multisine_then_pulse import MultisineThenPulse as MultisineThenPulse
from armperturb.perturbations.perturbation import Perturbation as Perturbation
from armperturb.perturbations.perturbation import check_bandwidth as check_bandwidth
from armperturb.perturbations.pulse import Pulse as Pulse
from armperturb.perturbations.pulse import draw_onset as draw_onset
from armperturb.perturbations.rest import Rest as Rest
from armperturb.perturbations.sampled import Sampled as Sampled
from armperturb.perturbations.sampled import load_perturbation as load_perturbation
from armperturb.perturbations.sampled import save_perturbation as save_perturbation
