"""Light transport that the integrators share: poses, fields of view, flight through water, the surface connection."""
