from .kinematics import forward_and_jacobian as forward_and_jacobian, pose_errors as pose_errors
from .linear_response import stepped as stepped
from .paths import derivatives as derivatives, not_a_knot as not_a_knot, quaternion_products as quaternion_products
from .play import driven_through_play as driven_through_play, servo_through_play as servo_through_play
from .profile import (
    fastest_profile as fastest_profile,
    lower_ceiling as lower_ceiling,
    speed_change_sums as speed_change_sums,
    time_law as time_law,
    widen_dips as widen_dips,
)
from .rigid_bodies import regressor_columns as regressor_columns
from .samples import (
    evaluate_spline as evaluate_spline,
    moving_average_law as moving_average_law,
    tcp_rates as tcp_rates,
    time_stretch_factors as time_stretch_factors,
)
from .servo_arm import integrate as integrate
