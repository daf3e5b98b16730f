// Fails where Khronos' validator finds an error or a warning. Usage: node validate.js FILE.glb; gltf-validator 2.0.0-dev.3.10.
const fs = require("fs");
const validator = require("gltf-validator");

validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2]))).then((report) => {
  const { numErrors, numWarnings, messages } = report.issues;
  for (const m of messages.slice(0, 20)) console.log(m.severity, m.code, m.pointer, m.message);
  console.log(`${process.argv[2]}: ${numErrors} errors, ${numWarnings} warnings`, JSON.stringify(report.info));
  process.exitCode = numErrors + numWarnings > 0 ? 1 : 0;
});
