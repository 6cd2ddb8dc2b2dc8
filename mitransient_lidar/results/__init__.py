"""Result datasets, and their files."""

from mitransient_lidar.results.attributes import provenance as provenance
from mitransient_lidar.results.dataset import add_batches as add_batches
from mitransient_lidar.results.dataset import add_components as add_components
from mitransient_lidar.results.dataset import add_derivatives as add_derivatives
from mitransient_lidar.results.dataset import build as build
from mitransient_lidar.results.dataset import build_series as build_series
from mitransient_lidar.results.dataset import pixel_coordinates as pixel_coordinates
from mitransient_lidar.results.dataset import record_dims as record_dims
from mitransient_lidar.results.dataset import time_axis as time_axis
from mitransient_lidar.results.files import Given as Given
from mitransient_lidar.results.files import dataset_of as dataset_of
from mitransient_lidar.results.files import open as open
from mitransient_lidar.results.files import save as save
