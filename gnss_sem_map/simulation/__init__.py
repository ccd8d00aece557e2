"""Simulation of a town, a vehicle and its sensors: drives in KITTI raw format with exact truth.

`simulate(folder, seconds, seed)` writes one drive; `prepare(seconds, seed)` builds the same in memory, and its
`scan(k)` and `image(k)` render single frames. The same seed gives the same bytes, whatever the number of threads.

Revisits: `laps=N` leads N times around a block of the town in one drive. Between two passes the error of the navigation
unit is drawn anew, as if minutes lay between them. `session=K` is a drive of the same seed K days later, in its date
folder: other traffic, other parked cars at the kerbs, another error and other noise; signs, bollards, walls and fences
are gone, containers and signs have been put up, and facades come forward by an oriel of 0.8 to 1.2 m. All else is where
it was on Earth: the maps of two drives differ by their LocalFrames only, and `LocalFrame.pose_of` is exact. Compare
sessions of the same `seconds` and `laps`: the car that creeps out of its bay depends on the way, and the leaves of some
trees on that car. `changes_between(seed, J, K)` lists what came and went between any two sessions.

How the drive's sensors measure (KITTI's conventions, where they were measured on the real data):

- A sweep begins behind the car and turns clockwise; a point of azimuth a has the stamp
  start + (0.5 - a / 2 pi) (end - start), and a scan's stamp is the middle. Files hold ring after ring, azimuth
  increasing from 0. Points are not motion-compensated; moving objects are at their position of the ray's own time.
- An image is exposed 2 ms after its scan's stamp and stamped 10.5 ms after it: exposure = stamp - 8.5 ms.
- oxts rows of the drive follow the scans by 10.7 to 22.6 ms, jittering; the `_extract` twin has all rows, 100 Hz.
  The position error drifts slowly, 0.35 m (0.5 m up), as `pos_accuracy` says. With `gnss="consumer"` the positions are
  a receiver's: noise of 0.3 m on a drift of 0.95 m, together 1 m, as `pos_accuracy` says; all else is the unit's.

Files in `truth/` in the drive's folder (stamps in s since the first row of the drive's oxts, positions in m: east,
north, up in the LocalFrame at that row's position):

- `world.json`: `epoch_ns` (Unix time of stamp zero), `lat_deg`, `lon_deg`, `alt_m` (the LocalFrame), `seed`.
- `trajectory.tum` (100 Hz) and `trajectory_lidar.tum` (at the scans' stamps): T_map_imu, `stamp tx ty tz qx qy qz qw`.
- `labels/<frame>.label`: SemanticKITTI, uint32 per point: class in the low 16 bits (252 and above for objects that move
  at any time of the drive, also while they wait), instance in the high ones.
- `train_ids/<frame>.png`: the class image, Cityscapes trainIds, 255 void (parking bays, containers). Sky is 10.
- `single_frame/<frame>.label`: class of each visible point in that image alone (40 48 10 50 70), 0 elsewhere.
- `vehicles.csv`: all vehicles within 120 m at every scan's stamp: centre of the bottom, yaw, size, moving or not.
- `changes.json` (sessions above 0): what appeared and vanished since session 0 in the whole town, one box each: `cause`
  (`parked`: a vehicle; `built`), `name`, `labels` (SemanticKITTI ids of its parts), centre, yaw, size.
"""

from gnss_sem_map.simulation.camera import Camera as Camera
from gnss_sem_map.simulation.camera import SimulatedImage as SimulatedImage
from gnss_sem_map.simulation.camera import render_image as render_image
from gnss_sem_map.simulation.corruption import corrupt_class_image as corrupt_class_image
from gnss_sem_map.simulation.corruption import write_corrupted_labels as write_corrupted_labels
from gnss_sem_map.simulation.drive import Simulation as Simulation
from gnss_sem_map.simulation.drive import prepare as prepare
from gnss_sem_map.simulation.drive import simulate as simulate
from gnss_sem_map.simulation.lidar import Lidar as Lidar
from gnss_sem_map.simulation.lidar import SimulatedScan as SimulatedScan
from gnss_sem_map.simulation.lidar import render_scan as render_scan
from gnss_sem_map.simulation.sessions import Change as Change
from gnss_sem_map.simulation.sessions import changes_between as changes_between
from gnss_sem_map.simulation.town import Town as Town
from gnss_sem_map.simulation.town import build_town as build_town
from gnss_sem_map.simulation.world import Mover as Mover
from gnss_sem_map.simulation.world import World as World
