"""Recordings of laboratories: read, checked against physics, repaired as asked, and written for other programs."""

from armperturb.convert.exporter import export_recording as export_recording
from armperturb.convert.importer import Imported as Imported
from armperturb.convert.importer import import_recording as import_recording
from armperturb.convert.template import SidecarTemplate as SidecarTemplate
from armperturb.convert.template import write_sidecar as write_sidecar
