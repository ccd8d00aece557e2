"""Every reader of the package, by name, with a file that it takes."""

from faults.drive_files import DRIVE_FILES
from faults.own_files import OWN_FILES

READERS = DRIVE_FILES | OWN_FILES
