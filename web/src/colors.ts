/** The colour map "inferno" of matplotlib (CC0) in 33 steps, as confidence_image in morgs_mi/playback/visualise.py. */
const HEX = (
  "000004 040312 0b0724 150b37 210c4a 2f0a5b 3d0965 4a0c6b 57106e 64156e 71196e " +
  "7d1e6d 8a226a 972766 a32c61 b0315b bc3754 c63d4d d04545 da4e3c e35933 eb6429 " +
  "f1711f f67e14 f98c0a fb9b06 fcaa0f fbba1f f9c932 f5d949 f2e865 f3f586 fcffa4"
).split(" ");

/** RGBA, from static to moving. */
export const CONFIDENCE_COLORS = Uint8Array.from(HEX.flatMap((hex) => [hex.slice(0, 2), hex.slice(2, 4), hex.slice(4), "ff"]), (byte) => parseInt(byte, 16));

export const CONFIDENCE_GRADIENT = HEX.map((hex) => `#${hex}`).join(", ");
