from .console import (
    Console as Console,
    end_progress as end_progress,
    finite as finite,
    fit_to_show as fit_to_show,
    print_json as print_json,
    print_path as print_path,
    print_text as print_text,
)
from .documents import (
    LARGEST_JSON as LARGEST_JSON,
    LARGEST_PROGRAM as LARGEST_PROGRAM,
    LARGEST_ROBOT_FILE as LARGEST_ROBOT_FILE,
    find_faults as find_faults,
    first_fault as first_fault,
    line_of as line_of,
    load_document as load_document,
    read_bytes as read_bytes,
    read_json as read_json,
    read_text as read_text,
    read_yaml as read_yaml,
    validate_document as validate_document,
    without_faults as without_faults,
)
from .errors import (
    FULL_OR_READ_ONLY as FULL_OR_READ_ONLY,
    AgentError as AgentError,
    BusyError as BusyError,
    ControllerError as ControllerError,
    InputError as InputError,
    MismatchError as MismatchError,
    RejectedError as RejectedError,
    SafetyError as SafetyError,
)
from .files import (
    open_regular as open_regular,
    sha256_file as sha256_file,
    sha256_text as sha256_text,
    swept_folder as swept_folder,
    write_atomically as write_atomically,
    written_whole as written_whole,
)
from .formats import (
    and_list as and_list,
    comma_list as comma_list,
    counted as counted,
    csv_text as csv_text,
    error_text as error_text,
    plus_minus as plus_minus,
)
from .numerics import (
    NORMAL_95 as NORMAL_95,
    keep_freed_memory as keep_freed_memory,
    on_one_blas_thread as on_one_blas_thread,
    one_blas_thread as one_blas_thread,
    symmetric_eigen as symmetric_eigen,
)
from .on_dask import DaskEngine as DaskEngine
from .output import (
    flush_results as flush_results,
    open_standard_descriptors as open_standard_descriptors,
    patient_messages as patient_messages,
    without_secrets as without_secrets,
)
from .packages import needed as needed, package_version as package_version
from .parallel import (
    InProcess as InProcess,
    LocalProcesses as LocalProcesses,
    TaskEngine as TaskEngine,
    available_cores as available_cores,
)
from .signals import (
    Ended as Ended,
    deferred as deferred,
    hang_up as hang_up,
    interrupted as interrupted,
    signals_raised as signals_raised,
    stop_to_come as stop_to_come,
    undisturbed as undisturbed,
    words_of as words_of,
)
from .units import Bare as Bare, Dimension as Dimension, Quantity as Quantity, parse_quantity as parse_quantity
