"""Free flight, phase functions and index layers of the water."""
