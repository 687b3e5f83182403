from .execution import Summary as Summary, run_fleet as run_fleet
from .page import write_page as write_page
from .result_file import is_result as is_result
from .simulate import simulate_fleet as simulate_fleet
from .tasks import make_question as make_question
from .trends import fleet_trends as fleet_trends, write_trends as write_trends
