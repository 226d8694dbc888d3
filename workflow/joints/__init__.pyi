from .config import JointsConfig as JointsConfig, TwoJointSource as TwoJointSource
from .machine import simulated_points as simulated_points
from .page import JOINTS_REPORT as JOINTS_REPORT, write_joints_page as write_joints_page
from .results import JointsResults as JointsResults
from .stages import SEVERAL_JOINTS as SEVERAL_JOINTS
from .words import summarise_joints as summarise_joints
