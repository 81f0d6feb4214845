"""Second-order stationarity: certificate, report, callback."""

from sb3_crpn.sosp.callback import SospCallback
from sb3_crpn.sosp.certificate import certify_sosp
from sb3_crpn.sosp.inference import Interval
from sb3_crpn.sosp.report import SospReport
from sb3_crpn.sosp.spectrum import Spectrum

__all__ = ["Interval", "SospCallback", "SospReport", "Spectrum", "certify_sosp"]
