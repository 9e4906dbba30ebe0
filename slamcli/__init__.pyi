from slamcli.core.camera.calibration import Calibration as Calibration
from slamcli.core.config import FeatureOptions as FeatureOptions
from slamcli.core.config import MapperOptions as MapperOptions
from slamcli.core.config import MatchOptions as MatchOptions
from slamcli.core.errors import CalibrationError as CalibrationError
from slamcli.core.errors import FrameError as FrameError
from slamcli.core.errors import InputError as InputError
from slamcli.core.errors import MapError as MapError
from slamcli.core.errors import OutputError as OutputError
from slamcli.core.errors import SlamcliError as SlamcliError
from slamcli.core.geometry import Grid as Grid
from slamcli.core.geometry import Pose2 as Pose2
from slamcli.core.records import FloorMap as FloorMap
from slamcli.core.records import Frame as Frame
from slamcli.core.records import Link as Link
from slamcli.core.records import PoseEstimate as PoseEstimate
from slamcli.core.telemetry import CompassReading as CompassReading
from slamcli.core.telemetry import Georeference as Georeference
from slamcli.core.telemetry import GpsReading as GpsReading
from slamcli.core.telemetry import OdometryReading as OdometryReading
from slamcli.core.telemetry import TelemetryOptions as TelemetryOptions
from slamcli.io.calibrations import load_calibration as load_calibration
from slamcli.io.map_file import load_map as load_map
from slamcli.mapping.localizer import Follower as Follower
from slamcli.mapping.localizer import Locator as Locator
from slamcli.mapping.mapper import Mapper as Mapper

__version__: str
