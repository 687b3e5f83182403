from .active_scoring import WAYS as WAYS, active_scores as active_scores, active_text as active_text
from .cases import GROUP as GROUP, OPEN as OPEN, Case as Case, draw_cases as draw_cases, mounted as mounted
from .check import BlindCheck as BlindCheck
from .key import key_text as key_text, open_key as open_key, seal as seal
from .report import summary_text as summary_text
from .runs import fake_controller as fake_controller
from .scoring import class_of as class_of
from .worlds import second_world as second_world
