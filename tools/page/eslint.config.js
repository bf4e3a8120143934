import js from "@eslint/js";
import globals from "globals";

export default [
  { ignores: ["**/uplot.js"] },
  js.configs.recommended,
  {
    languageOptions: { ecmaVersion: 2023, sourceType: "module", globals: globals.browser },
    rules: { eqeqeq: "error", "no-implicit-globals": "error", "no-unused-vars": "error" },
  },
];
