from .kinematics import apart as apart, forward_and_jacobian as forward_and_jacobian
from .linear_response import stepped as stepped
from .paths import derivatives as derivatives, not_a_knot as not_a_knot, products as products
from .play import driven_through_play as driven_through_play, servo_through_play as servo_through_play
from .profile import fastest as fastest, growth as growth, held as held, law_at as law_at, lowered as lowered
from .rigid_bodies import regressor_columns as regressor_columns
from .samples import averaged as averaged, sampled_on as sampled_on, stretched as stretched, tcp_rates as tcp_rates
from .servo_arm import march as march
