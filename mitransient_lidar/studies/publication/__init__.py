"""Figures and statements of the multipixel lidar model of FOI (Tulldahl 2006, FOI-R--2074--SE), computed again."""
