from .arm_numbers import numbers_of_file as numbers_of_file
from .registry import TARGETS as TARGETS, write_target as write_target
