"""torchpose: markerless joint angles and activities of a person from a stereo or depth camera, as tensor programs."""

from torchpose.activity.dataset import Clip, read_skeletons
from torchpose.activity.recognizer import Recognizer, RecognizerConfig
from torchpose.body.angle import ANATOMICAL_NAMES, LIMB_ANGLE_NAMES, anatomical_angles, limb_angles
from torchpose.body.ellipsoid import algebraic_distance, foot_point, nearest_point
from torchpose.body.model import BodyConfig, BodyModel, PosedBody
from torchpose.bvh import write_bvh
from torchpose.c3d_file import write_c3d
from torchpose.export import PoseSequence, read_poses_csv, read_poses_npz
from torchpose.eyes import Eyes, EyesConfig
from torchpose.least_squares import LMConfig, levenberg_marquardt
from torchpose.level import level_sequence
from torchpose.motion_export import ExportConfig
from torchpose.opensim import write_mot, write_trc
from torchpose.people import People, PeopleConfig
from torchpose.pipeline import PoseConfig, StereoToPose
from torchpose.recording import Frame, Recording, open_recording, write_recording
from torchpose.registration.likelihood import Evidence, PartLikelihood
from torchpose.registration.size import read_size
from torchpose.registration.vem import Observation, Registrar, RegistrationConfig
from torchpose.rendered import demo_recording
from torchpose.tracking.tracker import Tracker, TrackingConfig, TrackStatus
from torchpose.trajectory_filter import FilterKind, filter_sequence
from torchpose.version import __version__
from torchpose.vision.background import BackgroundModel, DepthBackground
from torchpose.vision.camera import RawStereo, StereoCamera
from torchpose.vision.disparity import Disparity
from torchpose.vision.faces import FaceDetector, Faces
from torchpose.vision.floor import Floor
from torchpose.vision.growing_seeds import GrowingSeeds, GrowingSeedsConfig
from torchpose.vision.points import PointCloud, group_cells, sample_grid
from torchpose.vision.semi_global import SemiGlobal, SemiGlobalConfig
from torchpose.vision.silhouette import person_silhouette
from torchpose.vision.stereo import MatcherKind, StereoConfig, stereo_matcher

__all__ = [
    "ANATOMICAL_NAMES",
    "LIMB_ANGLE_NAMES",
    "BackgroundModel",
    "BodyConfig",
    "BodyModel",
    "Clip",
    "DepthBackground",
    "Disparity",
    "Evidence",
    "ExportConfig",
    "Eyes",
    "EyesConfig",
    "FaceDetector",
    "Faces",
    "FilterKind",
    "Floor",
    "Frame",
    "GrowingSeeds",
    "GrowingSeedsConfig",
    "LMConfig",
    "MatcherKind",
    "Observation",
    "PartLikelihood",
    "People",
    "PeopleConfig",
    "PointCloud",
    "PoseConfig",
    "PoseSequence",
    "PosedBody",
    "RawStereo",
    "Recognizer",
    "RecognizerConfig",
    "Recording",
    "Registrar",
    "RegistrationConfig",
    "SemiGlobal",
    "SemiGlobalConfig",
    "StereoCamera",
    "StereoConfig",
    "StereoToPose",
    "TrackStatus",
    "Tracker",
    "TrackingConfig",
    "__version__",
    "algebraic_distance",
    "anatomical_angles",
    "demo_recording",
    "filter_sequence",
    "foot_point",
    "group_cells",
    "level_sequence",
    "levenberg_marquardt",
    "limb_angles",
    "nearest_point",
    "open_recording",
    "person_silhouette",
    "read_poses_csv",
    "read_poses_npz",
    "read_size",
    "read_skeletons",
    "sample_grid",
    "stereo_matcher",
    "write_bvh",
    "write_c3d",
    "write_mot",
    "write_recording",
    "write_trc",
]
